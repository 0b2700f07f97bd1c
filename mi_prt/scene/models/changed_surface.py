"""Materials that change the surface below another one: bumps, normals, opacity. The change is left
out.
"""

from . import MATERIALS, bsdfs_of


def _without(kind, change):
    @MATERIALS.add(kind)
    def model(bsdf, children, model_child):
        modelled, left_out = model_child(bsdfs_of(children)[0])
        return modelled, (f"{kind}: {change}", *left_out)

    return model


bump_map = _without("BumpMap", "bumps")
normal_map = _without("NormalMap", "normal map")
mask = _without("MaskBSDF", "opacity (treated as opaque)")
