"""Every public name: listed, documented, typed, and clear about what it computes."""

from __future__ import annotations

import ast
import re

import pytest

from snn_fusion_failure.documentation import api as render_api
from snn_fusion_failure.documentation.api import Module

MODULES = [m for package in render_api.PACKAGES for m in render_api.public_modules(package)]

# A function that takes or gives arrays says what it computes by an equation, a shape or a source.
# Those below take or give trees of parameters, for which the summary says all there is.
NO_FORMULA = {
    "fusion.detection.learning.fitting.frame_order": "indices of frames",
    "fusion.detection.kitti.geometry_files.write_plane": "writes a file",
    "fusion.detection.kitti.text.parse_number": "reads one number of a file",
    "fusion.detection.learning.objective.detector_loss": "a sum of terms with docstrings of their own",
    "fusion.detection.learning.scoring.image_scale": "one factor, named by the summary",
    "fusion.detection.learning.training.learning_rate": "one number, named by the summary",
    "fusion.lattice.inputs.require_width": "refuses, computes nothing",
    "fusion.models.init": "parameters of the model that the configuration names",
    "fusion.targets.init_targets": "parameters of the lattice networks",
    "fusion.train.init_state": "parameters and optimizer state",
    "failure.rev_argate.train_space": "maps another public function over seeds",
}
KEY = re.compile(r"Key\[Array, \"\"\]")
ARRAY = re.compile(r"\b(Array|ndarray|Float|Int|Bool)\b|-> float\b")
SHAPE_IN_TYPE = re.compile(r"\b(?:Float|Int|Bool|Key|UInt8|Num|Shaped)\[[\w.| ]+, \"[^\"]*\"\]")
SHAPE_IN_TEXT = re.compile(r"\[[\w ,.*+/()-]*\]")
EQUATION = re.compile(r" = |math::|:math:|\\\(|Eq\.|(?<=`)[^`]*[=<>+*^][^`]*(?=`)")
SOURCE = re.compile(r"Source:|Eq\.|\b(19|20)\d\d\b|section \d|Table \d|Figure \d")


def signature_text(node: ast.FunctionDef) -> str:
    return f"{ast.unparse(node.args)} -> {ast.unparse(node.returns) if node.returns else ''}"


def test_enough_is_found() -> None:
    assert sum(len(m.definitions) for m in MODULES) > 500
    assert sum(len(functions_of(m)) for m in MODULES) > 350


def test_page_of_public_names_is_up_to_date() -> None:
    render_api.main(render_api.Config(check=True))


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_module_says_what_it_is_and_lists_what_it_has(module: Module) -> None:
    assert len(module.summary) > 20, "a module starts with a docstring"
    assert len(set(module.names)) == len(module.names)
    known = {*module.definitions, *module.imported, *module.assigned}
    siblings = {p.stem for p in module.path.parent.iterdir()}
    missing = [n for n in module.names if n not in known and n not in siblings]
    assert missing == [], f"{module.name}.__all__ lists what is not there"
    assert not [n for n in module.names if n.startswith("_")]


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_docstrings_start_with_a_summary(module: Module) -> None:
    for name in filter(module.definitions.__contains__, module.names):
        summary = render_api.summary_of(module.definitions[name])
        assert len(summary) >= 5, f"{name} has no docstring"
        assert re.search(r"[.?:)]`*$", summary), f"{name}: not a sentence: {summary!r}"
        assert len(summary) <= 320, f"{name}: the rest belongs below a blank line: {summary!r}"


def functions_of(module: Module) -> dict[str, ast.FunctionDef]:
    """The public functions that a module defines."""
    found = {n: module.definitions[n] for n in module.names if n in module.definitions}
    return {n: node for n, node in found.items() if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_arguments_and_results_are_typed(module: Module) -> None:
    for name, node in functions_of(module).items():
        a = node.args
        everything = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
        bare = [arg.arg for arg in everything if arg.annotation is None]
        assert bare == [] and node.returns is not None, f"{name}: type {bare or 'the result'}"


def states_what_it_computes(node: ast.FunctionDef) -> bool:
    """Is there an equation, a shape or a source; true for a function without arrays."""
    # One key is no array: it says nothing about what is computed, and needs no shape.
    signature = KEY.sub("", signature_text(node).replace("'", '"'))
    text = ast.get_docstring(node) or ""
    if not ARRAY.search(signature):
        return True
    return bool(
        SHAPE_IN_TYPE.search(signature)
        or SHAPE_IN_TEXT.search(text)
        or EQUATION.search(text)
        or SOURCE.search(text)
    )


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_functions_of_arrays_say_what_they_compute(module: Module) -> None:
    for name, node in functions_of(module).items():
        if f"{module.name}.{name}" not in NO_FORMULA:
            assert states_what_it_computes(node), f"{name}: give equation, shapes or source"


def test_exceptions_are_needed() -> None:
    functions = {f"{m.name}.{n}": node for m in MODULES for n, node in functions_of(m).items()}
    assert set(NO_FORMULA) <= set(functions)
    needless = [name for name in NO_FORMULA if states_what_it_computes(functions[name])]
    assert needless == []


@pytest.mark.parametrize(
    ("code", "good"),
    [
        ("def f(x: Array) -> Array:\n    '''Some numbers.'''", False),
        ("def f(x: Array) -> Array:\n    '''The sum `y = a + b`.'''", True),
        ("def f(x: Array) -> Array:\n    '''Rows `[n, 2]`.'''", True),
        ("def f(x: Array) -> Array:\n    '''A rule.\n\n    Source: Florian (2007).'''", True),
        ("def f(x: Float[Array, 'n 2']) -> Array:\n    '''Some numbers.'''", True),
        ("def f(x: Path) -> None:\n    '''Write it.'''", True),
    ],
)
def test_the_rule_itself(code: str, good: bool) -> None:
    (node,) = ast.parse(code).body
    assert isinstance(node, ast.FunctionDef)
    assert states_what_it_computes(node) is good
