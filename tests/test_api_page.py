"""Every public name: listed by task, documented, typed, and clear about what it computes."""

from __future__ import annotations

import ast
import re

import pytest

from snn_fusion_failure.documentation import api, docstrings, formulas, reading
from snn_fusion_failure.documentation.reading import Module

ROOMS = ("jaxsnn", "fusion", "failure", "snn_fusion_failure")
MODULES = [m for room in ROOMS for m in reading.public_modules(room)]
NAMES = [name for package in api.PACKAGES for name in api.listed(package)]
# A list that grows stops being a promise: what comes in takes the place of something.
LISTED = 125

# A function that takes or gives arrays says what it computes by an equation, a shape or a source.
# Those below take or give trees of parameters, for which the summary says all there is.
NO_FORMULA = {
    "fusion.models.init": "parameters of the model that the configuration names",
    "fusion.train.init_state": "parameters and optimizer state",
}
KEY = re.compile(r"Key\[Array, \"\"\]")
ARRAY = re.compile(r"\b(Array|ndarray|Float|Int|Bool)\b|-> float\b")
SHAPE_IN_TYPE = re.compile(r"\b(?:Float|Int|Bool|Key|UInt8|Num|Shaped)\[[\w.| ]+, \"[^\"]*\"\]")
SHAPE_IN_TEXT = re.compile(r"\[[\w ,.*+/()-]*\]")
EQUATION = re.compile(r" = |math::|:math:|\\\(|Eq\.|(?<=`)[^`]*[=<>+*^][^`]*(?=`)")
SOURCE = re.compile(r"Source:|Eq\.|\b(19|20)\d\d\b|section \d|Table \d|Figure \d")


def signature_text(node: ast.FunctionDef) -> str:
    return f"{ast.unparse(node.args)} -> {ast.unparse(node.returns) if node.returns else ''}"


def test_the_list_is_short_enough_to_keep() -> None:
    count = {package: len(api.listed(package)) for package in api.PACKAGES}
    assert 90 <= sum(count.values()) <= LISTED, count


def test_pages_of_public_names_are_up_to_date() -> None:
    api.main(api.Config(check=True))


@pytest.mark.parametrize("name", NAMES, ids=lambda n: n.path)
def test_a_public_name_has_a_docstring(name: api.Name) -> None:
    assert re.search(r"[.?:)]`*$", name.text), f"not a sentence: {name.text!r}"
    assert 5 <= len(name.text) <= 320


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_module_says_what_it_is(module: Module) -> None:
    assert len(module.summary) > 20, "a module starts with a docstring"
    assert len(set(module.names)) == len(module.names)


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_docstrings_start_with_a_summary(module: Module) -> None:
    for name in filter(module.definitions.__contains__, module.names):
        summary = reading.summary_of(module.definitions[name])
        assert len(summary) >= 5, f"{name} has no docstring"
        assert re.search(r"[.?:)]`*$", summary), f"{name}: not a sentence: {summary!r}"
        assert len(summary) <= 320, f"{name}: the rest belongs below a blank line: {summary!r}"


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_arguments_and_results_are_typed(module: Module) -> None:
    for name in module.names:
        node = module.definitions.get(name)
        if not isinstance(node, ast.FunctionDef):
            continue
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


@pytest.mark.parametrize("package", api.PACKAGES)
def test_functions_of_arrays_say_what_they_compute(package: str) -> None:
    silent = [
        where
        for where, node in api.functions(package)
        if where not in NO_FORMULA and not states_what_it_computes(node)
    ]
    assert silent == [], "give equation, shapes or source"


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


def formulas_of(node: ast.AST) -> list[tuple[str, bool]]:
    """(formula, on a line of its own) of a docstring."""
    text = docstrings.to_markdown(ast.get_docstring(node) or "")  # type: ignore[arg-type]
    shown = [(f, True) for f in re.findall(r"\\\[(.*?)\\\]", text, re.DOTALL)]
    return shown + [(f, False) for f in re.findall(r"\\\((.*?)\\\)", text, re.DOTALL)]


@pytest.mark.parametrize("room", ROOMS[:3])
def test_formulas_of_docstrings_can_be_shown(room: str) -> None:
    pytest.importorskip("latex2mathml")
    for module in reading.public_modules(room):
        tree = ast.parse(module.path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                for formula, display in formulas_of(node):
                    formulas.to_mathml(formula, display=display)


def test_directives_become_marked_formulas() -> None:
    text = "A sum.\n\n.. math:: s = a\n    + b\n\nSymbols: :math:`a` is an :func:`fusion.x.f`."
    shown = docstrings.to_markdown(text)
    assert "\\[s = a\n+ b\\]" in shown and "\\(a\\) is an `f`" in shown
    text = ".. math::\n    x = 1\n\n    y = 2\n\nand more"
    assert docstrings.to_markdown(text).strip().startswith("\\[x = 1\ny = 2\\]")


def test_formulas_need_no_script() -> None:
    pytest.importorskip("latex2mathml")
    page = '<p>Of <span class="arithmatex">\\(a &lt; b\\)</span></p>'
    made = formulas.convert_page(page)
    assert 'alttext="a &lt; b"' in made and "<mo>&#x0003C;</mo>" in made
    with pytest.raises(ValueError, match=r"nosuch is not known; use another command"):
        formulas.to_mathml(r"\nosuch", display=False)
