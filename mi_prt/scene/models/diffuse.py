"""Diffuse reflection: modelled as it is."""

from . import MATERIALS


@MATERIALS.add("SmoothDiffuse")
def diffuse(bsdf, children, model_child):
    """See `scene.models`."""
    return bsdf, ()
