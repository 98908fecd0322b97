"""Every public name says what it returns, what it refuses, and shows one use that the suite runs."""

from __future__ import annotations

import ast
import re

import pytest

from snn_fusion_failure.documentation import api
from snn_fusion_failure.documentation.documented import PAGES
from snn_fusion_failure.documentation.reading import find_file, read_module

NAMES = [name for package in api.PACKAGES for name in api.listed(package) if name.node is not None]
CODE = "\n".join(
    block
    for page in PAGES
    if page.parent.name == "tutorials" or page.name == "README.md"
    for block in re.findall(
        r"(?<!-->\n)```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )
)
"""The Python blocks that test_docs.py and test_readme.py execute."""

NO_EXAMPLE = {
    "fusion.detection.evaluate": "reads frames; tests/fusion/test_detection_evaluate.py calls it",
    "fusion.detection.fit_detector": "trains; tests/fusion/test_detection_script.py calls it",
    "fusion.detection.make_example": "reads a frame; tests/fusion/test_detection_network.py calls it",
    "fusion.detection.read_frame": "reads a frame; tests/fusion/test_detection_io.py calls it",
    "fusion.detection.run_detector": "needs a trained detector; test_detection_script.py calls it",
}
"""Names whose use takes files or minutes, and where they are used instead."""


def raises(node: ast.AST) -> bool:
    """Does the body raise, or hand an argument to a check."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Raise):
            return True
        if isinstance(inner, ast.Call):
            called = ast.unparse(inner.func).split(".")[-1]
            if re.match(r"_?(check|require)(_|$)", called):
                return True
    return False


def example_of(name: api.Name) -> bool:
    """Does a docstring, its own or its module's, or executed documentation use the name."""
    path = find_file(name.home)
    assert path is not None and name.node is not None
    own = ast.get_docstring(name.node) or ""
    module = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    word = rf"\b{name.name}\b"
    lines = [line for line in module.splitlines() if line.lstrip().startswith((">>>", "..."))]
    return ">>>" in own or bool(re.search(word, "\n".join([*lines, CODE])))


def missing(node: ast.FunctionDef | ast.ClassDef) -> list[str]:
    """Sections that the docstring of a definition lacks."""
    text = ast.get_docstring(node) or ""
    body: ast.AST = node
    lacks = []
    if isinstance(node, ast.ClassDef):
        made = [n for n in node.body if getattr(n, "name", "") in ("__post_init__", "__init__")]
        body = ast.Module(body=list(made), type_ignores=[])
    elif node.returns is not None and ast.unparse(node.returns) not in ("None", "NoReturn"):
        lacks += [] if "Returns:" in text else ["Returns"]
    if raises(body) and "Raises:" not in text:
        lacks.append("Raises")
    return lacks


@pytest.mark.parametrize("name", NAMES, ids=lambda n: n.path)
def test_a_docstring_says_what_is_returned_and_refused(name: api.Name) -> None:
    assert name.node is not None
    assert missing(name.node) == []


@pytest.mark.parametrize("name", NAMES, ids=lambda n: n.path)
def test_a_public_name_is_shown_in_use(name: api.Name) -> None:
    if isinstance(name.node, ast.ClassDef) and name.name.endswith(("Error", "Diverged")):
        return  # an exception is raised for the user, not made by him
    assert example_of(name) is not (name.path in NO_EXAMPLE), "an example, or a line in NO_EXAMPLE"


@pytest.mark.parametrize("package", api.PACKAGES)
def test_a_listed_module_shows_itself(package: str) -> None:
    for name in api.listed(package):
        if name.kind == "module":
            path = find_file(name.home)
            assert path is not None
            shown = [n for n in read_module(path).definitions.values() if ">>>" in ast.unparse(n)]
            assert shown or example_in(path.read_text(encoding="utf-8"), name.name), name.path


def example_in(text: str, name: str) -> bool:
    """Does a module's docstring have an example, or executed documentation use it."""
    return ">>>" in (ast.get_docstring(ast.parse(text)) or "") or f"{name}." in CODE


@pytest.mark.parametrize(
    ("code", "lacks"),
    [
        ("def f(x: int) -> int:\n    '''Sum.'''", ["Returns"]),
        ("def f(x: int) -> None:\n    '''Write.'''", []),
        ("def f(x):\n    '''Check.'''\n    raise ValueError(x)", ["Raises"]),
        ("def f(x):\n    '''Check.\n\n    Raises:\n        ValueError: no.'''\n    check_n(x)", []),
        ("class A:\n    '''A.'''\n    def __post_init__(self): require(self.n > 0)", ["Raises"]),
        ("class A:\n    '''A.'''\n    def use(self): raise ValueError", []),
    ],
)
def test_the_rule_itself(code: str, lacks: list[str]) -> None:
    (node,) = ast.parse(code).body
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    assert missing(node) == lacks
