"""Materials with a diffuse texture under other lobes, which are left out."""

from ...system.runtime import mitsuba
from ..albedo import albedo_texture, measure_coat
from . import MATERIALS, black


def _plastic(kind, lobes):
    """A plastic whose base is met once reflects its parameter, beside its coat; that of one with
    `nonlinear` is no albedo, and what the coat reflects is spread evenly with the rest.
    """

    @MATERIALS.add(kind)
    def model(bsdf, children, model_child):
        reflectance, coat = dict(children)["diffuse_reflectance"], measure_coat(bsdf)
        if coat.keeps_parameter:
            left_out = f"{kind}: {lobes}"
        else:
            reflectance = albedo_texture(reflectance, coat)
            left_out = f"{kind}: {lobes} (its light is spread evenly)"
        return mitsuba().load_dict({"type": "diffuse", "reflectance": reflectance}), (left_out,)

    return model


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


plastic = _plastic("SmoothPlastic", "specular coat")
rough_plastic = _plastic("RoughPlastic", "glossy coat")
principled = _coated(
    "Principled", "base_color", "specular, sheen, clearcoat and transmission lobes"
)
principled_thin = _coated("PrincipledThin", "base_color", "specular, sheen and transmission lobes")
