"""No public function of arrays is left out of the checks under jit, vmap and scan."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

from snn_fusion_failure.documentation import api as render_api
from tests._api import functions_named

TESTS = Path(__file__).resolve().parent
ARRAY = re.compile(r"\bArray\b")
KEY = re.compile(r"Key\[Array, ''\]")

# Functions whose compiled use is that of another public function, named here.
INSIDE = {
    "fusion.encoders.stacked_dense": "fusion.models.predict",
    "fusion.lattice.shapes.interior": "fusion.lattice.grid.project",
    "fusion.lattice.shapes.project_vertices": "fusion.lattice.grid.project",
    "fusion.lattice.shapes.violation": "fusion.lattice.grid.check",
    "fusion.train.batch_loss": "fusion.train.make_train",
    "fusion.train.init_state": "fusion.train.make_train",
    "fusion.train.train_step": "fusion.train.make_train",
    "fusion.detection.network.detector.crop_views": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.learning.gate_objective.class_losses": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.learning.objective.detector_loss": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.geometry.proposals.propose": "fusion.detection.learning.fitting.run_detector",
    "fusion.detection.geometry.proposals.view_boxes": "fusion.detection.learning.fitting.run_detector",
    "fusion.detection.simulator.materials.surfaces": "fusion.detection.simulator.sensors.render",
    "fusion.detection.learning.training.fail_sensor": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.learning.training.train_step": "fusion.detection.learning.fitting.fit_detector",
    "fusion.detection.learning.training.training_inputs": "fusion.detection.learning.fitting.fit_detector",
    "failure.circuits.buck.cycle.until": "failure.circuits.buck.cycle.pwm_cycle",
    "failure.circuits.buck.cycle.walk": "failure.circuits.buck.cycle.pwm_cycle",
    "failure.circuits.solver.solve.newton": "failure.circuits.solver.solve.dc",
}
# Functions that work on the host: they check, or loop over programs that are compiled inside.
HOST = {
    "jaxsnn.encoding.check_rates": "refuses bad rates before anything is compiled",
    "fusion.lattice.inputs.require_width": "refuses bad shapes while tracing",
    "failure.active.activity": "counts on the host what a search found",
    "failure.bnn.init": "the first weights of `fit`",
    "failure.rev_argate.check_active": "compares two fits on the host",
    "failure.rev_argate.make_space": "the host's end of `fit`",
}


def array_functions(package: str) -> list[str]:
    """Public functions with jax arrays (more than one key) in their signature."""
    found = []
    for module in render_api.public_modules(package):
        for name in module.names:
            node = module.definitions.get(name)
            if isinstance(node, ast.FunctionDef):
                result = ast.unparse(node.returns) if node.returns else ""
                if ARRAY.search(KEY.sub("", f"{ast.unparse(node.args)} -> {result}")):
                    found.append(f"{module.name}.{name}")
    return found


def in_the_table(package: str) -> set[str]:
    table = importlib.import_module(f"tests.{package}.test_api_{package}")
    return {f"{package}.{name}" for name in functions_named(table.CASES)}


def compiled_in_its_own_test(package: str, function: str) -> bool:
    """Does a test that calls the function by name also jit, vmap or scan."""
    module, name = function.split(".")[-2:]
    called = re.compile(rf"\b{module}\.{name}\b|^    {name},$|import [^\n]*\b{name}\b", re.M)
    for path in (TESTS / package).glob("test_*.py"):
        text = path.read_text(encoding="utf-8")
        if called.search(text) and re.search(r"jax\.(jit|vmap)|lax\.(scan|map)", text):
            return True
    return False


@pytest.mark.parametrize("package", render_api.PACKAGES)
def test_every_function_of_arrays_is_covered(package: str) -> None:
    functions, table = array_functions(package), in_the_table(package)
    public = {f"{m.name}.{n}" for m in render_api.public_modules(package) for n in m.names}
    assert table <= public, "the table names what is not public"
    left = [
        name
        for name in functions
        if name not in table
        and name not in INSIDE
        and name not in HOST
        and not compiled_in_its_own_test(package, name)
    ]
    assert left == [], "give them a case in the table, or a test of their own"


def test_exceptions_name_what_exists() -> None:
    everything = {
        f"{module.name}.{name}"
        for package in render_api.PACKAGES
        for module in render_api.public_modules(package)
        for name in module.names
    }
    assert {*INSIDE, *INSIDE.values(), *HOST} - everything == set()
