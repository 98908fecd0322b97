from __future__ import annotations

import json
import sys
import time
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from failure import CommandSimulator, FunctionSimulator, Status
from failure.simulators.processes import SimulatorError
from failure.simulators.result_cache import Cache

GOOD, FAILED, TIMED_OUT, NOT_FINITE = (
    Status.GOOD,
    Status.FAILED,
    Status.TIMED_OUT,
    Status.NOT_FINITE,
)

PROGRAM = """
import json, pathlib, sys, time
x = json.loads(sys.stdin.readline())
log = pathlib.Path(sys.argv[1])
with log.open("a") as f:
    f.write("run\\n")
mode = x[0]
if mode == 1.0:
    sys.exit(3)
if mode == 2.0:
    time.sleep(30)
if mode == 3.0:
    print("[NaN, 1.0]"); sys.exit(0)
if mode == 4.0:
    print("no numbers"); sys.exit(0)
if mode == 5.0 and len(log.read_text().splitlines()) < 2:
    sys.exit(1)
print("working ...")
print(json.dumps([sum(x), max(x)]))
"""


@pytest.fixture
def program(tmp_path: Path) -> tuple[list[str], Path]:
    file, log = tmp_path / "program.py", tmp_path / "log"
    file.write_text(PROGRAM)
    log.write_text("")
    return [sys.executable, "-I", "-S", str(file), str(log)], log


def runs(log: Path) -> int:
    return len(log.read_text().splitlines())


def total_or_trouble(x: np.ndarray) -> list[float]:
    if x[0] == 1.0:
        raise RuntimeError("singular matrix")
    if x[0] == 2.0:
        time.sleep(60)
    return [float(np.sum(x)), float("nan") if x[0] == 3.0 else 1.0]


def test_command_keeps_order_and_reads_the_last_line(program) -> None:
    argv, _ = program
    x = np.array([[10.0, 1.0], [11.0, 2.0], [12.0, -3.0]])
    specs, status = CommandSimulator(argv, 2, workers=3)(x)
    np.testing.assert_array_equal(specs, [[11.0, 10.0], [13.0, 11.0], [9.0, 12.0]])
    assert status.tolist() == [GOOD] * 3


def test_trouble_is_recorded_and_the_rest_goes_on(program) -> None:
    argv, log = program
    simulate = CommandSimulator(argv, 2, workers=2, timeout=10.0, retries=0)
    x = np.array([[1.0], [2.0], [3.0], [4.0], [7.0]])
    specs, status = simulate(x)
    assert status.tolist() == [FAILED, TIMED_OUT, NOT_FINITE, FAILED, GOOD]
    assert np.all(np.isnan(specs[[0, 1, 3]]))
    assert specs[4].tolist() == [7.0, 7.0]
    assert "exit status 3" in simulate.messages[0] and "10.0 s" in simulate.messages[1]
    assert simulate.simulations == runs(log) == 5


def test_retry_rescues_a_flaky_run(program) -> None:
    argv, log = program
    specs, status = CommandSimulator(argv, 2, retries=1)(np.array([[5.0]]))
    assert status.tolist() == [GOOD] and specs[0, 0] == 5.0 and runs(log) == 2


def test_cache_pays_once_within_a_batch_and_between_runs(program, tmp_path: Path) -> None:
    argv, log = program
    x = np.array([[8.0], [9.0], [8.0], [1.0]])
    first = CommandSimulator(argv, 2, retries=0, cache=tmp_path / "cache")(x)
    assert runs(log) == 3
    again = CommandSimulator(argv, 2, retries=0, cache=tmp_path / "cache")(x[::-1])
    assert runs(log) == 3
    np.testing.assert_array_equal(again[0], first[0][::-1])
    np.testing.assert_array_equal(again[1], first[1][::-1])
    CommandSimulator(argv, 2, retries=0, cache=tmp_path / "cache", retry_failed=True)(x)
    assert runs(log) == 4
    CommandSimulator(argv, 2, retries=0, cache=tmp_path / "cache", version="2")(x[:1])
    assert runs(log) == 5


@pytest.mark.parametrize(
    "record",
    [
        "{}",
        '{"specs": [1.0, 2.0]}',
        '{"specs": 3, "status": 0, "message": ""}',
        '{"specs": [1.0], "status": 0, "message": ""}',
        '{"specs": [1.0, 2.0], "status": null, "message": ""}',
    ],
)
def test_a_record_without_its_parts_is_set_aside_and_simulated_again(
    program, tmp_path: Path, record: str
) -> None:
    argv, log = program
    x = np.array([[0.5, 2.0]])
    simulate = CommandSimulator(argv, 2, cache=tmp_path / "cache")
    specs, _ = simulate(x)
    (path,) = (tmp_path / "cache").rglob("*.json")
    path.write_text(record)
    again, _ = simulate(x)
    np.testing.assert_array_equal(again, specs)
    assert runs(log) == 2 and path.with_suffix(".broken").read_text() == record


def test_cache_key_follows_the_content_of_dependencies(program, tmp_path: Path) -> None:
    argv, log = program
    card = tmp_path / "card"
    for text, wanted in (("a", 1), ("a", 1), ("b", 2)):
        card.write_text(text)
        CommandSimulator(argv, 2, cache=tmp_path / "cache", depends=[card])(np.array([[8.0]]))
        assert runs(log) == wanted


def test_an_interrupted_batch_loses_nothing(program, tmp_path: Path) -> None:
    argv, log = program
    cache = Cache(tmp_path / "cache", CommandSimulator(argv, 2)._batch.identity)
    cache.save(np.array([8.0]), [1.5, 2.5], GOOD, "")
    (cache.path(np.array([8.0])).parent / ".half.json").write_text('{"specs": [')
    specs, _ = CommandSimulator(argv, 2, cache=tmp_path / "cache")(np.array([[8.0], [9.0]]))
    assert specs[0].tolist() == [1.5, 2.5] and runs(log) == 1
    held = json.loads(cache.path(np.array([9.0])).read_text())
    assert held["x"] == [9.0] and held["specs"] == [9.0, 9.0]


def test_function_in_worker_processes(tmp_path: Path) -> None:
    simulate = FunctionSimulator(
        total_or_trouble, 2, workers=1, timeout=60.0, retries=0, cache=tmp_path
    )
    x = np.array([[4.0, 1.0], [1.0, 0.0], [3.0, 0.0]])
    specs, status = simulate(x)
    assert status.tolist() == [GOOD, FAILED, NOT_FINITE]
    assert specs[0].tolist() == [5.0, 1.0]
    assert "singular matrix" in simulate.messages[1]
    simulate(x)
    assert simulate.simulations == 3


def scaled_total(row: np.ndarray, factor: float = 1.0) -> list[float]:
    return [factor * float(row.sum())]


def test_a_partial_runs_and_is_cached_under_its_arguments(tmp_path: Path) -> None:
    x = np.array([[1.0, 2.0]])
    for factor, simulations in ((2.0, 1), (3.0, 1), (2.0, 0)):
        simulate = FunctionSimulator(partial(scaled_total, factor=factor), 1, cache=tmp_path)
        specs, status = simulate(x)
        assert status.tolist() == [GOOD] and specs.tolist() == [[3.0 * factor]]
        assert simulate.simulations == simulations
    # The name of a plain function is what it was: caches on the disk stay good.
    plain = FunctionSimulator(scaled_total, 1)._batch.identity
    assert f"function {__name__}.scaled_total version 1" in plain


def test_a_function_that_no_process_can_import_is_an_error_and_not_a_wait(monkeypatch) -> None:
    """Neither one that cannot be sent at all nor one whose module a new process does not find."""
    module = types.ModuleType("script_loaded_by_its_path")
    exec("def lost(x):\n    return [0.0]", module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for function in (lambda x: x, module.lost):
        simulate = FunctionSimulator(function, 1, retries=0)
        with pytest.raises(SimulatorError, match="a top-level function of a module"):
            simulate(np.zeros((1, 1)))


@pytest.mark.slow
def test_function_that_hangs_is_ended() -> None:
    simulate = FunctionSimulator(total_or_trouble, 2, timeout=5.0, retries=0)
    _, status = simulate(np.array([[2.0], [4.0]]))
    assert status.tolist() == [TIMED_OUT, GOOD]


def test_bad_settings_and_rows_are_named(program) -> None:
    argv, _ = program
    with pytest.raises(ValueError, match="workers=0"):
        CommandSimulator(argv, 2, workers=0)
    with pytest.raises(ValueError, match="timeout=-1"):
        CommandSimulator(argv, 2, timeout=-1.0)
    with pytest.raises(ValueError, match=r"x\[1\]=.*expected finite"):
        CommandSimulator(argv, 2)(np.array([[0.0], [np.nan]]))
    with pytest.raises(ValueError, match="no-such-simulator"):
        CommandSimulator(["no-such-simulator"], 1)(np.zeros((1, 1)))
