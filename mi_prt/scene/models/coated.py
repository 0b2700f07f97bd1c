"""Materials with a diffuse texture under other lobes, which are left out."""

from ...system.runtime import mitsuba
from . import MATERIALS, black


def _coated(kind, texture, lobes):
    @MATERIALS.add(kind)
    def model(bsdf, children, model_child):
        textures = dict(children)
        mi = mitsuba()
        diffuse = mi.load_dict({"type": "diffuse", "reflectance": textures[texture]})
        for share in ("metallic", "spec_trans"):
            if share in textures:  # that share of the surface has no diffuse lobe
                weight = textures[share]
                diffuse = mi.load_dict(
                    {"type": "blendbsdf", "weight": weight, "first": diffuse, "second": black()}
                )
        return diffuse, (f"{kind}: {lobes}",)

    return model


plastic = _coated("SmoothPlastic", "diffuse_reflectance", "specular coat")
rough_plastic = _coated("RoughPlastic", "diffuse_reflectance", "glossy coat")
principled = _coated(
    "Principled", "base_color", "specular, sheen, clearcoat and transmission lobes"
)
principled_thin = _coated("PrincipledThin", "base_color", "specular, sheen and transmission lobes")
