"""The asset of a scene in which lights move: everything that relighting it needs (Meshless PRT,
section 5).
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import LightError, SettingsError
from ..lighting.emission import Emission, emission_of
from ..lighting.light import as_light
from ..points.interpolate import SampleInterpolator
from ..points.samples import Samples
from ..system.parallel import one_blas_thread
from ..transport.depth import DepthBuffers
from ..transport.local_direct import LocalDirect
from ..transport.transfer_matrix import Transfer
from . import meshless_file

COMPONENTS = ("total", "direct", "indirect")


@dataclass(frozen=True, eq=False)
class MeshlessAsset:
    """A scene's visibility and direct-to-indirect transfer at sample points.

    Parameters
    ----------
    samples : Samples
    depth : DepthBuffers
    transfer : Transfer or None
        None where no light is reflected from one point to another, or none was asked for.
    own_light : Emission
        The scene's own local emitters.
    scene, settings, versions, report : dict
        As of `Asset`.
    path : Path or None
        The file it was loaded from or saved to.
    """

    samples: Samples
    depth: DepthBuffers
    transfer: Transfer | None
    own_light: Emission
    scene: dict
    settings: dict
    versions: dict
    report: dict
    path: Path | None = field(default=None, compare=False)

    @property
    def points(self):
        """The sample points, Points."""
        return self.samples.points

    @cached_property
    def buried(self):
        """No sample is, (n,) bool: particles do not get where light does not."""
        return np.zeros(len(self.points), bool)

    @property
    def reference_bounces(self):
        """Reflections that the truth has; None is any number."""
        bounces = self.settings["bounces"]
        return None if bounces == "auto" else bounces

    # --- relighting -------------------------------------------------------------------------------

    def irradiance(self, light=None, component="total"):
        """Irradiance at the points, (n, 3) float32 in W/m².

        Parameters
        ----------
        light : PointLight, SpotLight, AreaLight, Light, or a list of these, optional
            Anywhere, inside the scene or outside; what they send adds up. By default the scene's
            own local emitters.
        component : 'total', 'direct' or 'indirect'

        Raises
        ------
        LightError
            If a light is distant, or there is none and the scene has none of its own.
        SettingsError
            If the component is another.
        """
        if component not in COMPONENTS:
            raise SettingsError(
                f"component '{component}' is not known: use {', '.join(COMPONENTS)}"
            )
        direct, averaged = self._direct.irradiance(self.emission(light))
        if component == "direct":
            return direct
        indirect = self._indirect(averaged)
        return indirect if component == "indirect" else direct + indirect

    def relight(self, light=None, component="total"):
        """Outgoing radiance B = ρ/π · E at the points, (n, 3) float32 in W/(m²·sr).

        See `irradiance`.
        """
        return self.outgoing_radiance(self.irradiance(light, component))

    def outgoing_radiance(self, irradiance):
        """Outgoing radiance B = ρ/π · E (n, 3) of irradiance (n, 3) at the points."""
        return irradiance * self._reflection

    def emission(self, light=None):
        """Emission of lights as `irradiance` takes them; see there for errors."""
        if light is None:
            if not len(self.own_light):
                raise LightError(self.report["no_own_light"])
            return self.own_light
        light = as_light(light)
        if not light.distant.is_empty:
            raise LightError(
                "this asset holds visibility and transfer for local lights (points='samples'), and"
                " a light is distant: pass point, spot or area lights, or precompute the scene with"
                " points='vertices'"
            )
        return emission_of(light)

    def _indirect(self, averaged):
        """Indirect irradiance (n, 3); what compression leaves of it below zero is zero."""
        if self.transfer is None:
            return np.zeros_like(averaged)
        with one_blas_thread():
            indirect = self.transfer.indirect(averaged, self.samples.clusters)
        return np.maximum(indirect, 0, out=indirect)

    @cached_property
    def _direct(self):
        return LocalDirect(self.samples, self.depth)

    @cached_property
    def _reflection(self):
        return self.points.albedo * np.float32(1 / np.pi)

    def interpolator(self, scene):
        """What gives irradiance between the points at hits on a Scene, a SampleInterpolator."""
        return SampleInterpolator(scene, self.samples)

    # --- file -------------------------------------------------------------------------------------

    def save(self, path, folder=None):
        """Write the asset to one file, all or nothing; see `Asset.save`."""
        meshless_file.write(self, path, folder)
        object.__setattr__(self, "path", Path(path).absolute())
