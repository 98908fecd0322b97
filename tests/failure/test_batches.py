"""Several points at a time: batches of a search, and workers that end at different times."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from failure.models.acquisition import AcquisitionConfig
from failure.search import bayesopt
from failure.search.methods import SearchConfig
from failure.search.runs import run
from failure.search.storage import samples
from failure.search.task import Task
from failure.search.workers import run_workers
from failure.simulators import SimulatorError

TASK = Task("ball", 5.0, 6)


def hill(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y = x[:, :1] + 0.1 * x[:, 1:2] ** 2
    return y, np.zeros(len(x))


def search(**change) -> SearchConfig:
    return SearchConfig(TASK, **{"n_init": 8, "n_total": 24, **change})


def test_a_batch_is_spread_and_finds_what_single_points_find() -> None:
    four = search(acquisition=AcquisitionConfig(batch_size=4))
    state = run(four, hill)
    assert state.y.shape == (1, 24)
    blocks = state.x[0, 8:].reshape(4, 4, 6)
    gaps = np.linalg.norm(blocks[:, :, None] - blocks[:, None], axis=-1) + 9.0 * np.eye(4)
    assert gaps.min() > 1e-3
    one = run(search(), hill)
    assert state.y.max() > 4.5 and one.y.max() > 4.5


def test_the_last_batch_fills_the_budget() -> None:
    state = run(search(n_total=18, acquisition=AcquisitionConfig(batch_size=4)), hill)
    assert state.y.shape == (1, 18)


def test_a_point_under_way_is_not_asked_again() -> None:
    config = search()
    state = bayesopt.init(config)
    x, state = bayesopt.ask(config, state)
    state = bayesopt.tell(config, state, hill(x[0])[0].T)
    first, asked = bayesopt.ask(config, state)
    again, _ = bayesopt.ask(config, state)
    np.testing.assert_array_equal(first, again)
    busy = asked.pending[1]
    second, _ = bayesopt.ask(config, state, busy=busy)
    assert np.linalg.norm(second - first) > 1e-2


@pytest.mark.slow
def test_workers_do_not_wait_for_the_slowest(tmp_path) -> None:
    """One simulation, of the initial design, lasts until twenty others have ended."""
    lock, others, eight = threading.Lock(), threading.Event(), threading.Barrier(8)
    calls = [0]

    def simulate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with lock:
            number = calls[0]
            calls[0] += 1
            if calls[0] >= 24:
                others.set()
        if number < 8:
            eight.wait(300.0)  # All workers are busy at once.
        if number == 3:
            assert others.wait(300.0)
        return hill(x)

    state = run_workers(search(n_init=12, n_total=30), simulate, workers=8, folder=tmp_path)
    assert state.y.shape == (1, 30) and state.y.max() > 4.0
    x, y = samples(tmp_path)
    np.testing.assert_array_equal(y, state.y[0])
    longer = run_workers(search(n_init=12, n_total=32), simulate, workers=8, folder=tmp_path)
    assert calls[0] == 32
    np.testing.assert_array_equal(longer.x[0, :30], x)


def test_workers_stop_a_simulator_that_never_works(tmp_path) -> None:
    calls = []

    def broken(x: np.ndarray) -> None:
        calls.append(len(x))
        raise KeyError("no licence")

    for _ in range(2):
        with pytest.raises(SimulatorError, match="never worked; its last message: KeyError: 'no l"):
            run_workers(search(), broken, workers=2, folder=tmp_path, retries=0)  # type: ignore
    assert 8 <= len(calls) < 24


def test_bad_requests() -> None:
    with pytest.raises(ValueError, match=r"seeds=\(0, 1\): expected one"):
        run_workers(search(seeds=(0, 1)), hill, workers=2)
    with pytest.raises(ValueError, match="method='active_subspace'"):
        run_workers(search(method="active_subspace"), hill, workers=2)
    with pytest.raises(ValueError, match="workers=0"):
        run_workers(search(), hill, workers=0)
    with pytest.raises(ValueError, match="batch_size=0"):
        AcquisitionConfig(batch_size=0)
