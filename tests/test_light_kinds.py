"""All kinds of light through one suite; a kind of another project; sums of parts."""

from dataclasses import dataclass

import numpy as np
import OpenEXR
import pytest
from conftest import sky_of, uniform_sky
from light_suite import LATTICE, LightSuite

from mi_prt import EnvironmentMap, Light, LightError, PointLight, SceneLight
from mi_prt.lighting.cells import cell_radiance
from mi_prt.lighting.light import as_light
from mi_prt.lighting.parse import forms, parse_light
from mi_prt.lighting.part import LIGHTS, LocalPart


class TestPoint(LightSuite):
    TEXT = "point:0.3,1.5,0.4:3,2,1"
    LIMIT = 1e-5


class TestSpot(LightSuite):
    TEXT = "spot:0.3,1.5,0.4:-0.2,-1,0:3,2,1:60:20"
    LIMIT = 1e-4


class TestArea(LightSuite):
    """25 places for 0.4 m at 1.5 m: 1 % (test_local_emitters)."""

    TEXT = "area:0.3,1.5,0.4:0.4,0,0:0,0,0.4:3,2,1"
    LIMIT = 0.01


class TestDirectional(LightSuite):
    TEXT = "directional:0.3,-1,0.2:3,2,1"


class TestEnvironment(LightSuite):
    @pytest.fixture(autouse=True)
    def written(self, tmp_path):
        path = tmp_path / "sky.exr"
        OpenEXR.File({}, {"RGB": sky_of(lambda d: np.exp(d), 32)}).write(str(path))
        self.TEXT = f"envmap:{path}"
        self.LIMIT = 0.01


def test_every_kind_has_a_suite():
    """The scene's own light has tests of its own, in test_own_lights."""
    assert set(LIGHTS) == {"point", "spot", "area", "directional", "envmap", "scene"}


def test_a_kind_of_another_project_is_one_class(monkeypatch):
    """Registered, it is parsed, named in the forms, summed with others and seen as local."""
    LIGHTS["point"]  # what is there already is imported
    monkeypatch.setattr(LIGHTS, "_kinds", dict(LIGHTS._kinds))

    @LIGHTS.register
    @dataclass(frozen=True, eq=False)
    class Candle(LocalPart):
        height: float

        kind = "candle"
        FORM = "candle:height"

        @classmethod
        def parse(cls, text):
            return cls(float(text))

        def emission(self):
            return PointLight([0, self.height, 0], 1.0).emission()

        def scaled(self, factor):
            return self

        def to_mitsuba(self):
            return PointLight([0, self.height, 0], 1.0).to_mitsuba()

    candle = parse_light("candle:2")
    assert candle.height == 2 and "candle:height" in forms()
    light = as_light([candle, uniform_sky()])
    assert light.local.parts == (candle,)
    with pytest.raises(LightError, match="candle light cannot be moved"):
        candle.moved([0, 0, 0])


def test_sums_of_lights():
    sky, lamp = EnvironmentMap(uniform_sky()), PointLight([0, 1, 0], 1)
    both = as_light(sky) + lamp
    assert both.parts == (sky, lamp) and (as_light(lamp) + [sky, lamp]).parts == (lamp, sky, lamp)
    dimmed = 0.5 * both
    np.testing.assert_allclose(cell_radiance(dimmed.distant, LATTICE), 0.5, rtol=1e-5)
    np.testing.assert_array_equal(dimmed.local.parts[0].intensity, [0.5] * 3)
    assert Light().is_empty and not both.of_scene and as_light([lamp, "scene"]).of_scene
    with pytest.raises(LightError, match="use a list"):
        Light((uniform_sky(),))
    with pytest.raises(LightError, match="looked up"):
        _ = as_light(SceneLight()).distant


def test_a_map_that_a_factor_makes_infinite_is_refused():
    with pytest.raises(LightError, match="not finite"):
        EnvironmentMap(np.full((2, 4, 3), 1e30)) * 1e10
