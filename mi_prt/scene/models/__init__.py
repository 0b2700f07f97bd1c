"""Models of materials: what transport stands for of each of Mitsuba's BSDF classes.

A model is one function, registered under the class name of the BSDF:

    @MATERIALS.add("SmoothDiffuse")
    def diffuse(bsdf, children, model_child):
        return bsdf, ()

Parameters
----------
bsdf : mi.BSDF
    As written.
children : list of (str, mi.Object)
    The objects below it, textures and other BSDFs.
model_child : callable(mi.BSDF) -> (mi.BSDF, tuple of str)
    The model of a BSDF below it.

Returns
-------
modelled : mi.BSDF
    Made of diffuse plugins; the same object where nothing is left out.
left_out : tuple of str
    What is not modelled, for example "BumpMap: bumps".
"""

from ...system.registry import Registry
from ...system.runtime import mitsuba

MATERIALS = Registry("material", "mi_prt.scene.models")


def black():
    """A BSDF that reflects nothing."""
    return mitsuba().load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}})


def bsdfs_of(children):
    """The BSDFs among the objects below one."""
    return [child for _, child in children if isinstance(child, mitsuba().BSDF)]
