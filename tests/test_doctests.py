"""Every example in a docstring runs, under the strict rules that the other tests run under."""

from __future__ import annotations

import ast
import doctest
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from snn_fusion_failure.documentation import reading

PARSER = doctest.DocTestParser()


def examples(path: Path) -> Iterator[tuple[str, str, int]]:
    """(name, docstring, line) of docstrings with an example of which nothing is skipped."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            continue
        text = ast.get_docstring(node)
        if not text or ">>>" not in text:
            continue
        if any(e.options.get(doctest.SKIP) for e in PARSER.get_examples(text)):
            continue
        yield getattr(node, "name", "module"), text, getattr(node, "lineno", 1)


MODULES = {
    module.name: found
    for package in ("jaxsnn", "fusion", "failure", "snn_fusion_failure")
    for module in reading.public_modules(package)
    if (found := list(examples(module.path)))
}


def test_examples_are_found() -> None:
    assert sum(map(len, MODULES.values())) >= 40


def with_marks(name: str) -> Any:
    """`fusion.modules` trains a network of its reader's own encoders, which compiles for long."""
    return pytest.param(name, marks=[pytest.mark.slow] if name == "fusion.modules" else [])


@pytest.mark.parametrize("name", [with_marks(name) for name in MODULES])
def test_examples_of_docstrings(name: str) -> None:
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(verbose=False)
    report: list[str] = []
    for owner, text, line in MODULES[name]:
        test = PARSER.get_doctest(
            text, dict(vars(module)), f"{name}.{owner}", module.__file__, line
        )
        runner.run(test, out=report.append)
    assert runner.failures == 0, "".join(report)
    assert runner.tries > 0
