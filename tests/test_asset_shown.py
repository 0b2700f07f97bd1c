"""What an asset, the program and the package say of themselves."""

import re
from importlib import resources
from pathlib import Path

import pytest
from small_assets import opened_scene

import mi_prt
from mi_prt.cli import main

ROOT = Path(__file__).resolve().parent.parent


def test_an_asset_is_shown_in_one_line_and_as_a_table(tmp_path):
    asset = mi_prt.precompute(
        opened_scene(),
        transports="distant,own",
        edge_length=9.0,
        directions="cubemap:4",
        coefficients=4,
        lamp_rays=16,
    )
    line = repr(asset)
    assert len(line) < 250 and "\n" not in line
    for said in (
        "scene.xml",
        f"{len(asset.points):,}",
        "4 coefficients (pca) on cubemap:4",
        "bulb",
    ):
        assert said in line and said in asset._repr_html_()
    asset.save(tmp_path / "<b>.prt")
    table = mi_prt.load(tmp_path / "<b>.prt")._repr_html_()
    assert table.startswith("<table>") and "&lt;b&gt;.prt" in table


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as left:
        main(["--version"])
    assert not left.value.code and capsys.readouterr().out == f"mi-prt {mi_prt.__version__}\n"
    written = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {mi_prt.__version__}\n" in written
    assert len(re.findall(r"^  - type: ", written, re.MULTILINE)) == 3


def test_the_package_is_typed():
    assert resources.files("mi_prt").joinpath("py.typed").is_file()
    assert 'mi_prt = ["py.typed"]' in (ROOT / "pyproject.toml").read_text()
