"""The asset: everything that relighting needs."""

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..lighting.emission import emission_of
from ..lighting.environment import LightWarning
from ..lighting.light import Light, as_light
from ..lighting.local import arrival, hull_warning
from ..points.interpolate import PatchInterpolator
from ..points.points import Points
from ..system.parallel import BLOCK_ROWS, map_chunks, one_blas_thread
from . import asset_file


@dataclass(frozen=True, eq=False)
class Asset:
    """A scene's precomputed transport.

    Parameters
    ----------
    points : Points
    buried : (n,) bool
        Points inside or against other geometry; rendering takes their neighbours' light instead.
    directions : DirectionLattice
    basis : a basis of `basis.bases.BASES`
    coefficients : (n, d) float32
        An array, (n, 3, d) where reflections colour the light and the basis does not; a sparse
        array for the basis `haar`; the sampled `DirectTransport` (n, s) for the basis `none`.
    scene : dict
        kind, path, parameters, hash and left_out (what of the scene is not modelled).
    settings : dict
        What the run used.
    versions : dict
    report : dict
        Counts from sampling (rays, dark and buried points), captured variance and relative error of
        the transport, and how light splits by reflections (see `indirect`).
    path : Path or None
        The file it was loaded from or saved to.
    """

    points: Points
    buried: np.ndarray
    directions: object
    basis: object
    coefficients: object
    scene: dict
    settings: dict
    versions: dict
    report: dict
    path: Path | None = field(default=None, compare=False)

    # --- light ------------------------------------------------------------------------------------

    def project_light(self, light):
        """Distant light in this asset's basis.

        Parameters
        ----------
        light : Light or what `as_light` accepts
            Local lights in it are left aside: at each point they are another light.

        Returns
        -------
        coefficients : (d, 3) float32
        mean_response : (3,) float32

        """
        light = as_light(light)
        return self.basis.project(light.distant, self.directions)

    def prepare_light(self, light):
        """The same light in a form that turns in milliseconds.

        Maps are kept on a fine lattice; spherical harmonics turn them in closed form.

        >>> sky = asset.prepare_light("sky.exr")
        >>> for degrees in range(360):
        ...     asset.relight(sky.rotated("y", degrees))

        Parameters
        ----------
        light : Light or what `as_light` accepts

        Returns
        -------
        Light
        """
        return self.basis.prepare(as_light(light), self.directions)

    @property
    def channels(self):
        """Colour channels of transport: 3 where reflections colour the light, else 1."""
        return self.report.get("channels", 1)

    @cached_property
    def _channels_apart(self):
        """Whether each channel has coefficients of its own."""
        return isinstance(self.coefficients, np.ndarray) and self.coefficients.ndim == 3

    @property
    def reference_bounces(self):
        """Reflections that the truth has: as many as were asked for; None, any number, where that
        was left to the scene.
        """
        bounces = self.settings["bounces"]
        return None if bounces == "auto" else bounces

    # --- relighting -------------------------------------------------------------------------------

    def irradiance(self, light, nearest=1):
        """Irradiance at the points, (n, 3) float32 in W/m².

        Parameters
        ----------
        light : Light or what `as_light` accepts
            Any number of environment maps, directional and local lights; their irradiances add up.
        nearest : int
            Directions that stand for a local light (Eigentransport, section 4.2.1).

        Warns
        -----
        LightWarning
            If a local light is inside the convex hull of the scene: transport holds visibility to
            infinity.
        """
        light = as_light(light)
        places = emission_of(light).positions
        warning = hull_warning(places, self.points.hull) if len(places) else None
        if warning:
            warnings.warn(warning, LightWarning, stacklevel=2)
        return self.irradiance_from(*self.project_light(light), light, nearest)

    def irradiance_from(self, coefficients, mean_response, light=Light(), nearest=1):
        """Irradiance (n, 3) from distant light that is projected already, c·ℓ + m (Eigentransport
        eq. 10, mean kept exactly), and local lights.

        What compression leaves of the sum below zero is zero.
        """
        with one_blas_thread():
            if self._channels_apart:
                irradiance = np.matmul(self.coefficients.swapaxes(0, 1), coefficients.T[..., None])[
                    ..., 0
                ].T
            else:
                irradiance = self.coefficients @ coefficients
        irradiance += mean_response
        for arriving in self._arriving(light, nearest):
            irradiance += arriving
        return np.maximum(irradiance, 0, out=irradiance)

    def local_irradiance(self, light, nearest=1):
        """Irradiance (n, 3) float32 in W/m² by local lights alone, wherever they are; see
        `irradiance`.
        """
        none = np.zeros((len(self.points), 3), np.float32)
        return np.maximum(sum(self._arriving(as_light(light), nearest), none), 0)

    def _arriving(self, light, nearest):
        """Responses (n, 3) to the places of local light: the transport of the directions each is
        seen in times I/r² (eq. 4, erratum 3).
        """
        for cells, irradiance in arrival(
            emission_of(light), self.points.positions, self.directions, nearest
        ):
            seen = self._seen(cells)
            yield irradiance * (seen if seen.ndim == 2 else seen[:, None])

    def _seen(self, cells):
        """Mean transport of all points in their cells (n, k)."""

        def transport(first):
            block = slice(first, first + BLOCK_ROWS)
            return self.basis.at(self.coefficients[block], cells[block]).mean(axis=1)

        return np.concatenate(list(map_chunks(transport, range(0, len(self.points), BLOCK_ROWS))))

    def relight(self, light, nearest=1):
        """Outgoing radiance B = ρ/π · E at the points, (n, 3) float32 in W/(m²·sr).

        See `irradiance`.
        """
        return self.outgoing_radiance(self.irradiance(light, nearest))

    def outgoing_radiance(self, irradiance):
        """Outgoing radiance B = ρ/π · E (n, 3) of irradiance (n, 3) at the points."""
        return irradiance * self._reflection

    @cached_property
    def _reflection(self):
        return self.points.albedo * np.float32(1 / np.pi)

    def transport(self, rows):
        """Transport (len(rows), s) float32 as the basis reconstructs it, or (len(rows), 3, s);
        `rows` indexes points.
        """
        return self.basis.reconstruct(self.coefficients[rows])

    def interpolator(self, scene):
        """What gives irradiance between the points at hits on a Scene, a PatchInterpolator."""
        return PatchInterpolator(scene, self.points, self.buried)

    # --- file -------------------------------------------------------------------------------------

    def save(self, path, folder=None):
        """Write the asset to one file, all or nothing; see `asset_file`.

        Parameters
        ----------
        path : path
        folder : path, optional
            Where the file is until it is whole: on the same file system, by default in the folder
            of `path`.

        Raises
        ------
        SettingsError
            If the path cannot be written.
        """
        asset_file.write(self, path, folder)
        object.__setattr__(self, "path", Path(path).absolute())
