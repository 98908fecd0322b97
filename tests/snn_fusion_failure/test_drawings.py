"""Drawings of the documentation are made by code from what they show, and are up to date."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from failure.circuits.buck import schematic
from failure.circuits.ldo import schematic as ldo
from snn_fusion_failure.documentation import architecture, diagrams, imports, schematics, svg


def test_picture_of_the_architecture_is_up_to_date() -> None:
    architecture.main(architecture.Config(check=True))


def test_drawings_of_the_systems_are_up_to_date() -> None:
    diagrams.main(diagrams.Config(check=True))


def test_an_old_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.svg"
    architecture.keep(path, "a", check=False, command="c.py")
    architecture.keep(path, "a", check=True, command="c.py")
    with pytest.raises(ValueError, match=r"x\.svg is out of date: run `python c\.py`"):
        architecture.keep(path, "b", check=True, command="c.py")


@pytest.mark.parametrize("name", diagrams.DRAWINGS)
def test_drawings_are_whole(name: str) -> None:
    text = (diagrams.FOLDER / f"{name}.svg").read_text(encoding="utf-8")
    tree = ElementTree.fromstring(text)
    assert tree.find("{http://www.w3.org/2000/svg}title") is not None
    assert len(text) < 60_000 and "http" not in text.replace("http://www.w3.org/2000/svg", "")
    # Nothing lies outside of the ground.
    width, height = (float(tree.attrib[key]) for key in ("width", "height"))
    for x, y in re.findall(r'<text x="([-\d.]+)" y="([-\d.]+)"', text):
        assert 0 <= float(x) <= width and 0 <= float(y) <= height


def test_every_element_of_a_netlist_is_drawn() -> None:
    shown = schematics.ldo()
    for element in ldo.NETLIST.elements:
        assert element.name in schematics.SUPPLIES or f">{element.name}<" in shown
    shown = schematics.buck()
    for transistor in schematic.MOSFETS:
        assert f">{transistor.name}<" in shown


def test_an_element_without_a_place_is_refused() -> None:
    places = {k: v for k, v in schematics.LDO.items() if k != "MP"}
    canvas = svg.Canvas(10, 10, "x")
    with pytest.raises(ValueError, match=r"\['MP'\] stand in the netlist or here only"):
        schematics.draw_block(canvas, ldo.NETLIST.elements, places, 0, 0)


def test_uses_of_sub_rooms_are_read_off_the_imports() -> None:
    used = architecture.uses(imports.read())
    assert ("fusion", "") in used["failure", ""]
    assert ("snn_fusion_failure", "runs") in used["snn_fusion_failure", "sweeps"]
    assert used["fusion", "lattice"] == set()
