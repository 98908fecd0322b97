"""One convention each: order of arguments, keys by name, plots that return, plain backticks."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests import _conventions as conventions

ROOT = Path(__file__).resolve().parent.parent
FUNCTIONS = list(conventions.public_functions(*conventions.PACKAGES))


def test_arguments_come_as_config_params_state_inputs_key() -> None:
    found = {
        name: faults for name, node in FUNCTIONS if (faults := conventions.argument_faults(node))
    }
    assert found == {}


@pytest.mark.parametrize(
    ("code", "good"),
    [
        ("def f(config: C, params: P, state: S, x: Array, *, key: Key): ...", True),
        ("def init(key: Key, config: C): ...", True),
        ("def lif_init(params: LIFParams, n: int): ...", True),
        ("def f(params: P, config: C): ...", False),
        ("def f(model: ModelConfig, train: TrainParams, net: NetConfig): ...", False),
        ("def f(x: Float[Array, 'n'], params: P): ...", False),
        ("def f(key: Key, config: C): ...", False),
        ("def init(config: C, key: Key): ...", False),
        ("def f(make: Callable[[XConfig], int], params: P): ...", True),
        ("def f(x: Array, params: P = P()): ...", True),
    ],
)
def test_the_rule_itself(code: str, good: bool) -> None:
    (node,) = ast.parse(code).body
    assert isinstance(node, ast.FunctionDef)
    assert (conventions.argument_faults(node) == []) is good


def test_plots_return_a_figure_that_the_caller_saves() -> None:
    for name, node in FUNCTIONS:
        module, function = name.rsplit(".", 1)
        if module.endswith("plots"):
            result = ast.unparse(node.returns).strip("'\"") if node.returns else ""
            assert function.startswith("plot_"), name
            # One figure, or several by name.
            kind = result.removeprefix("dict[str, ").removesuffix("]").split(".")[-1]
            assert kind in ("Figure", "FuncAnimation"), f"{name} -> {result}"


def test_single_backticks() -> None:
    found = {
        str(path.relative_to(ROOT)): lines
        for room in (*conventions.PACKAGES, "scripts")
        for path in sorted((ROOT / room).rglob("*.py"))
        if (lines := conventions.double_backticks(path))
    }
    assert found == {}
