"""The structure that docs/architecture.md claims: imports point downward, kinds are asked."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "mi_prt"
LAYERS = (
    "errors",
    "system",
    "directions",
    "scene",
    "lighting",
    "points",
    "basis",
    "transport",
    "asset",
    "render",
    "precompute",
    "evaluate",
    "output",
    "cli",
)
# Classes that are kinds of something in a registry, or its base: code asks them.
KINDS = {
    "Basis LinearBasis PCA HarmonicBasis HaarBasis SharedHaarBasis NoBasis",
    "Transport DistantTransport OwnTransport LocalTransport Builder",
    "PointLight SpotLight AreaLight DirectionalLight EnvironmentMap SceneLight Lamp Emission",
    "Layout Patches Spacing Locator Format",
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def imported(path):
    """Absolute names of the package's modules that a module imports."""
    here = path.relative_to(PACKAGE.parent).with_suffix("").parts
    package = here[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - (node.level - 1)]
            yield (*base, *(node.module or "").split(".")) if node.module else base
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mi_prt"):
            yield tuple(node.module.split("."))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downward(path):
    layer = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if layer not in LAYERS:  # __init__ and __main__ name what is public
        return
    above = [
        ".".join(name)
        for name in imported(path)
        if len(name) > 1 and name[1] in LAYERS and LAYERS.index(name[1]) > LAYERS.index(layer)
    ]
    assert not above, f"{layer} imports what is above it: {above}"


def test_every_folder_is_a_layer():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert folders == set(LAYERS) - {"errors"}


def _is_kind(node):
    """Whether an expression is some `x.kind`, NumPy's `dtype.kind` excepted."""
    is_kind = isinstance(node, ast.Attribute) and node.attr == "kind"
    return is_kind and getattr(node.value, "attr", "") != "dtype"


def test_kinds_are_not_told_apart():
    """No `isinstance` of a registered kind, and no comparison of a `kind` with a text."""
    kinds, found = {name for line in KINDS for name in line.split()}, []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            place = f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
                names = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                if names & kinds:
                    found.append(place)
            if isinstance(node, ast.Compare) and "scene/" not in place and "points/" not in place:
                sides = [node.left, *node.comparators]
                asked = any(_is_kind(s) for s in sides)
                named = any(isinstance(getattr(s, "value", None), str) for s in sides)
                if asked and named:
                    found.append(place)
    assert not found, f"kinds are told apart at {found}"
