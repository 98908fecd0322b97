"""What CI leans on: lower bounds, constraints, parts of the slow tests."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests._scripts import load_script
from tests.conftest import pytest_collection_modifyitems

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
lowest = load_script("tools/check_lowest")


def test_every_requirement_has_a_lower_bound() -> None:
    pinned = lowest.lowest(PROJECT)
    assert len(pinned) >= 20 and all(re.fullmatch(r"[\w-]+==[\d.]+", pin) for pin in pinned)
    assert all((ROOT / name).is_file() for name in lowest.TESTS)
    with pytest.raises(ValueError, match="requirement='jax': expected name>=version"):
        lowest.lowest({"dependencies": ["jax"], "optional-dependencies": {"test": []}})


def test_constraints_pin_every_requirement_above_its_bound() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if not line.startswith("#")]
    assert all(len(pin) == 2 for pin in pins) and not any("/" in line for line in lines)
    held = {name.lower().replace("_", "-"): version for name, version in pins}

    def numbers(version: str) -> list[int]:
        return [int(part) for part in re.findall(r"\d+", version)]

    for pin in lowest.lowest(PROJECT):
        name, bound = pin.split("==")
        assert numbers(held[name]) >= numbers(bound), name


def test_another_python_has_to_be_there(tmp_path: Path) -> None:
    broken = tmp_path / "python9"
    broken.write_text("#!/bin/sh\nexit 127\n", encoding="utf-8")
    broken.chmod(0o755)
    for name in ("python0.1", str(broken)):
        with pytest.raises(ValueError, match="expected an interpreter; install it"):
            lowest.main(lowest.Config(python=name))


class Item:
    def __init__(self, nodeid: str, slow: bool) -> None:
        self.nodeid, self.slow = nodeid, slow

    def get_closest_marker(self, name: str) -> bool:
        return self.slow


class Config:
    def __init__(self, part: str) -> None:
        self.part, self.hook = part, self

    def getoption(self, name: str) -> str:
        return self.part

    def pytest_deselected(self, items: list[Item]) -> None:
        pass


def test_the_parts_of_the_slow_tests_make_up_all_of_them() -> None:
    seen: list[str] = []
    for part in range(3):
        items = [Item(f"t{i}", True) for i in range(7)] + [Item("quick", False)]
        pytest_collection_modifyitems(Config(f"{part}/3"), items)  # type: ignore[arg-type]
        names = [item.nodeid for item in items]
        assert "quick" in names
        seen += [name for name in names if name != "quick"]
    assert sorted(seen) == [f"t{i}" for i in range(7)]


@pytest.mark.parametrize("part", ["3/3", "x", "-1/3"])
def test_a_part_that_is_none_is_refused(part: str) -> None:
    with pytest.raises(pytest.UsageError, match="expected I/N with I < N"):
        pytest_collection_modifyitems(Config(part), [])  # type: ignore[arg-type]
