"""Materials that combine others: two sides, and blends."""

from ...system.runtime import mitsuba
from . import MATERIALS, bsdfs_of


@MATERIALS.add("TwoSidedBRDF")
def two_sided(bsdf, children, model_child):
    """Both sides modelled; see `scene.models`."""
    mi = mitsuba()
    modelled, left_out, changed = _modelled(children, model_child)
    if not changed:
        return bsdf, left_out
    # What has a back already (glass, a nested twosided) needs no second one.
    if any(mi.has_flag(m.flags(), mi.BSDFFlags.BackSide) for m in modelled):
        return modelled[0], left_out
    sides = {f"side{i}": m for i, m in enumerate(modelled)}
    return mi.load_dict({"type": "twosided", **sides}), left_out


@MATERIALS.add("BlendBSDF")
def blend(bsdf, children, model_child):
    """The blend of both models; see `scene.models`."""
    modelled, left_out, changed = _modelled(children, model_child)
    if not changed:
        return bsdf, left_out
    first, second = modelled
    weight = dict(children)["weight"]
    mixed = {"type": "blendbsdf", "weight": weight, "first": first, "second": second}
    return mitsuba().load_dict(mixed), left_out


def _modelled(children, model_child):
    """Models of the BSDFs below, what they leave out, and whether any is another."""
    nested = bsdfs_of(children)
    pairs = [model_child(child) for child in nested]
    modelled = [model for model, _ in pairs]
    left_out = sum((texts for _, texts in pairs), ())
    return modelled, left_out, any(a is not b for a, b in zip(nested, modelled))
