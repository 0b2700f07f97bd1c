"""What every kind of light must do. A test class of a kind derives from `LightSuite`."""

import numpy as np
import pytest
from conftest import bias, rectangle, relative_l2, scene

from mi_prt import LightError
from mi_prt.directions import parse_directions
from mi_prt.evaluate.ground_truth import point_irradiance
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.emission import emission_of
from mi_prt.lighting.light import as_light
from mi_prt.lighting.parse import parse_light
from mi_prt.lighting.rotation import rotation_matrix
from mi_prt.lighting.to_mitsuba import lit_scene
from mi_prt.points.points import sample_points
from mi_prt.scene.scene import open_scene

LATTICE = parse_directions("cubemap:32")
TURN = ("z", 25)
ROUNDING = 2e-4  # of a sum of 16,384 samples in float32, where a light has no noise


_FOUND = {}  # points and truth, by class


def plane():
    """An open plane y = 0, whose shapes shade nothing."""
    return scene(floor=rectangle(size=2))


def irradiance(part, points):
    """Irradiance (n, 3) that this program finds where nothing is in between."""
    light = as_light(part)
    cosines = np.maximum(points.normals @ LATTICE.vectors.T, 0) * LATTICE.solid_angles
    distant = cosines @ cell_radiance(light.distant, LATTICE)
    return distant + emission_of(light).irradiance(points.positions, points.normals)


class LightSuite:
    """Attributes to be given by a kind.

    TEXT : str
        A light that shines on the plane y = 0 around the origin, at any hour.
    LIMIT : float
        Relative RMSE and bias that its own approximation may have on the plane. Where it is
        distant, the cosine of the cell's centre counts: cells of cubemap:32 are up to 2.3° off,
        4 % at 45°.
    """

    TEXT: str
    LIMIT = 0.04

    @pytest.fixture
    def part(self):
        return parse_light(self.TEXT)

    def truth(self, part):
        opened = open_scene(plane())
        points = sample_points(opened, 0.5)
        return points, point_irradiance(lit_scene(opened, part), points, 1 << 14)

    def truth_as_found(self, part):
        """That of the light itself, neither turned nor scaled: found once for each kind."""
        if type(self) not in _FOUND:
            _FOUND[type(self)] = self.truth(part)
        return _FOUND[type(self)]

    def agree(self, part, points, truth):
        found = irradiance(part, points)
        assert truth.noise < 0.01 and truth.mean.max() > 0
        assert relative_l2(found, truth.mean) < self.LIMIT + ROUNDING + 2 * truth.noise
        assert abs(bias(found, truth.mean)) < self.LIMIT + ROUNDING + 2 * truth.noise

    def test_it_lights_a_plane_as_its_mitsuba_emitter_does(self, part):
        """From text to Mitsuba's plugin and back to irradiance, within the noise of Mitsuba's
        samples and the light's own approximation."""
        self.agree(part, *self.truth_as_found(part))

    def test_turned_it_still_is_the_light_that_mitsuba_shows(self, part):
        """Distant light turns, and a turn back is the light again; local light stays."""
        turned = part.rotated(*TURN)
        if not part.is_distant:
            assert turned is part
            return
        self.agree(turned, *self.truth(turned))
        back = turned.rotated(TURN[0], -TURN[1])
        np.testing.assert_allclose(
            cell_radiance(back, LATTICE), cell_radiance(part, LATTICE), rtol=1e-4, atol=1e-5
        )
        up = np.array([0.0, 1.0, 0.0]) @ rotation_matrix(*TURN).T
        assert relative_l2(up, [0, 1, 0]) > 0.1  # it was a turn that matters

    def test_scaled_it_is_a_multiple(self, part):
        """Light is linear: exact but for float32 in this program, and for the noise of two truths
        in Mitsuba, whose root mean square is exceeded threefold with p < 1e-6.
        """
        points, truth = self.truth_as_found(part)
        _, scaled = self.truth(part * [0.5, 0, 3])
        noise = ROUNDING + np.hypot(truth.noise, scaled.noise)
        assert relative_l2(scaled.mean, truth.mean * [0.5, 0, 3]) < 3 * noise
        assert not scaled.mean[:, 1].any()
        expected = irradiance(part, points) * [0.5, 0, 3]
        for dimmed in (part * [0.5, 0, 3], np.array([0.5, 0, 3]) * part):
            np.testing.assert_allclose(irradiance(dimmed, points), expected, rtol=1e-5, atol=1e-7)
        text = parse_light(f"{self.TEXT}*0.5,0,3")
        np.testing.assert_allclose(irradiance(text, points), expected, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(
            irradiance(2 * part, points), 2 * irradiance(part, points), rtol=1e-5
        )

    @pytest.mark.parametrize("factor", [-1, np.nan, np.inf, [1, 2], "bright", None])
    def test_a_factor_that_is_none_is_refused(self, part, factor):
        with pytest.raises(LightError, match="factor"):
            part.scaled(factor)

    def test_its_form_is_told_and_other_texts_are_refused_with_it(self, part):
        assert type(part).FORM.startswith(part.kind)
        for text in (part.kind, f"{part.kind}:", f"{self.TEXT}:x:y", f"{self.TEXT}*x"):
            with pytest.raises(LightError) as caught:
                parse_light(text)
            assert f"light '{text}'" in str(caught.value) and "\n" not in str(caught.value)

    def test_it_moves_where_it_says_so(self, part):
        """A moved light is at its new position and otherwise the same."""
        if not part.is_movable:
            assert part.is_distant
            return
        moved = part.moved([0.2, 1.7, 0.1])
        np.testing.assert_allclose(moved.position, [0.2, 1.7, 0.1])
        shift = moved.emission().positions - part.emission().positions
        np.testing.assert_allclose(shift, shift[:1].repeat(len(shift), axis=0), atol=1e-6)
        np.testing.assert_array_equal(moved.emission().intensity, part.emission().intensity)
