"""No public function of arrays is left out of the checks under jit, vmap and scan."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from snn_fusion_failure.documentation import api, reading
from tests._api import functions_named

TESTS = Path(__file__).resolve().parent
ROOMS = ("jaxsnn", "fusion", "failure")

# Functions whose compiled use is that of another public function, named here.
INSIDE = {
    "fusion.detection.learning.training.fail_sensor": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.learning.training.train_step": "fusion.detection.learning.fitting.fit_detector",
    "fusion.train.batch_loss": "fusion.train.make_train",
    "fusion.train.init_state": "fusion.train.make_train",
    "fusion.train.train_step": "fusion.train.make_train",
}
# Functions that work on the host: they check, or loop over programs that are compiled inside.
HOST = {
    "jaxsnn.encoding.check_rates": "refuses bad rates before anything is compiled",
}


def array_functions(room: str) -> list[str]:
    """Public functions with jax arrays in their signature, by where they are defined."""
    packages = [p for p in api.PACKAGES if p.split(".")[0] == room]
    return sorted(
        {
            where
            for package in packages
            for where, node in api.functions(package)
            if reading.is_function_of_arrays(node)
        }
    )


def in_the_table(room: str) -> set[str]:
    table = importlib.import_module(f"tests.{room}.test_api_{room}")
    return {f"{room}.{name}" for name in functions_named(table.CASES)}


def compiled_in_its_own_test(room: str, function: str) -> bool:
    """Does a test that calls the function by name also jit, vmap or scan."""
    module, name = function.split(".")[-2:]
    called = re.compile(rf"\b{module}\.{name}\b|^    {name},$|import [^\n]*\b{name}\b", re.M)
    for path in (TESTS / room).glob("test_*.py"):
        text = path.read_text(encoding="utf-8")
        if called.search(text) and re.search(r"jax\.(jit|vmap)|lax\.(scan|map)", text):
            return True
    return False


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_function_of_arrays_is_covered(room: str) -> None:
    left = {*array_functions(room)} - in_the_table(room) - set(INSIDE) - set(HOST)
    left = {name for name in left if not compiled_in_its_own_test(room, name)}
    assert left == set(), "give them a case in the table, or a test of their own"


@pytest.mark.parametrize("room", ROOMS)
def test_the_table_names_what_exists(room: str) -> None:
    everything = {f"{m.name}.{n}" for m in reading.public_modules(room) for n in m.definitions}
    # Cases may leave out the rooms between package and module.
    short = {f"{room}.{'.'.join(name.split('.')[-2:])}" for name in everything}
    lost = {
        name
        for name in in_the_table(room)
        if name not in everything and f"{room}.{'.'.join(name.split('.')[-2:])}" not in short
    }
    assert lost == set()
