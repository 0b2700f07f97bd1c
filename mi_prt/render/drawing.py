"""An asset's picture as an array."""

from ..asset.asset import DRAWINGS
from ..asset.provenance import open_scene_of
from ..errors import SettingsError
from .picture import Picture


@DRAWINGS.add("image")
def draw_image(
    asset, light, *, sensor, camera, size, spp, scene, rotate, component, direct, renderer
):
    """Linear radiance (h, w, 3); see `Asset.render`."""
    if camera is not None and sensor != 0:
        raise SettingsError(
            f"sensor {sensor!r} and a camera are both given: pass one of them to render"
        )
    opened = open_scene_of(asset, scene)
    resolved = asset.resolved(light, rotate, opened)
    picture = Picture(asset, opened, resolved, component, direct)
    irradiance = picture.irradiance()
    with picture.drawn(sensor if camera is None else camera, size, renderer, spp) as draw:
        return draw(irradiance)
