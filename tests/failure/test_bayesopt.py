import dataclasses
import json

import jax
import numpy as np
import pytest

from failure.models.acquisition import AcquisitionConfig
from failure.search import bayesopt, runs
from failure.search.task import Task

DIM = 4
ACQ = AcquisitionConfig(n_raw=64, n_restarts=3, max_evals=30)
BOX = Task("box", 3.0, DIM)


def bowl(x):
    """Largest at (2, -1, 0, 0), where it is 5; curvature and interaction."""
    x = np.asarray(x)
    y = 5.0 - (x[:, 0] - 2.0) ** 2 - (x[:, 1] + 1.0) ** 2 - 0.3 * (x[:, 2] * x[:, 0] + x[:, 3]) ** 2
    return y[:, None], np.zeros(len(x), int)


def config(method="full", **changes):
    settings = {
        "task": BOX,
        "method": method,
        "seeds": (0, 1),
        "n_init": 8,
        "n_total": 24,
    }
    if method == "pbo":
        settings["acquisition"] = dataclasses.replace(ACQ, name="pbo", batch_size=5)
    elif bayesopt.METHODS[method].surrogate if method in bayesopt.METHODS else False:
        settings["acquisition"] = ACQ
    return bayesopt.SearchConfig(**{**settings, **changes})


@pytest.fixture(scope="module")
def full_run():
    return runs.run(config(), bowl)


@pytest.mark.slow
def test_search_finds_the_maximum_that_random_sampling_misses(full_run):
    random = runs.run(config("monte_carlo"), bowl)
    assert full_run.y.shape == (2, 24)
    assert np.all(full_run.y.max(1) > 4.5)
    assert np.all(random.y.max(1) < full_run.y.max(1))
    assert np.all(np.abs(full_run.x) <= 3.0)


@pytest.mark.slow
def test_seeds_side_by_side_equal_seeds_alone(full_run):
    alone = runs.run(config(seeds=(1,)), bowl)
    # rounding differs between the two programs, and a search amplifies it: the first points
    np.testing.assert_allclose(alone.x[0, :11], full_run.x[1, :11], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("method", ["full", "turbo"])
def test_a_killed_run_goes_on_without_repeating_a_simulation(tmp_path, method, full_run):
    whole = full_run if method == "full" else runs.run(config(method), bowl)
    seen = []

    class Killed(BaseException):  # as an interrupt; an Exception is one point's own
        pass

    def counted(x):
        if sum(len(block) for block in seen) >= 26 and not counted.free:
            raise Killed
        seen.append(np.array(x))
        return bowl(x)

    counted.free = False
    with pytest.raises(Killed):
        runs.run(config(method), counted, folder=tmp_path)
    # a kill in the middle of a write leaves half a line
    with (tmp_path / "evaluations.jsonl").open("a") as file:
        file.write('{"n": 13, "x": [[')
    counted.free = True
    end = runs.run(config(method), counted, folder=tmp_path)
    rows = np.concatenate(seen)
    assert len(rows) == 2 * 24 and len(np.unique(rows, axis=0)) == 2 * 24
    np.testing.assert_array_equal(end.x, whole.x)
    np.testing.assert_array_equal(end.y, whole.y)
    # a complete run is complete
    again = runs.run(config(method), counted, folder=tmp_path)
    assert len(np.concatenate(seen)) == 2 * 24
    np.testing.assert_array_equal(again.y, end.y)


def test_other_settings_are_refused_with_the_difference(tmp_path):
    runs.run(config("monte_carlo"), bowl, folder=tmp_path)
    with pytest.raises(ValueError, match=r"n_total: 24 -> 20; seeds: \[0, 1\] -> \[0, 5\]"):
        runs.run(config("monte_carlo", n_total=20, seeds=(0, 5)), bowl, folder=tmp_path)
    assert json.loads((tmp_path / "search.json").read_text())["n_total"] == 24


@pytest.mark.parametrize("method", ["ridge_corner", "gradient_corner"])
def test_a_linear_specification_falls_to_its_corner(method):
    slope = np.array([1.0, -2.0, 0.5, 3.0])

    def linear(x):
        return (np.asarray(x) @ slope)[:, None], np.zeros(len(x), int)

    for task, best in ((BOX, 3 * 6.5), (Task("ball", 3.0, DIM), 3 * np.linalg.norm(slope))):
        state = runs.run(config(method, task=task, n_total=12), linear)
        assert np.allclose(state.y.max(1), best, rtol=0.05 if task.kind == "ball" else 1e-9)
        # eight samples to fit, or D + 1 differences; then the corner
        assert np.all(bayesopt.first_hit(state.y, 0.9 * best) <= 11)


def test_a_ball_is_never_left():
    state = runs.run(config(task=Task("ball", 1.5, DIM), n_total=14), bowl)
    assert np.all(np.linalg.norm(state.x, axis=2) <= 1.5 + 1e-9)
    assert state.y.max() > 3.5


def test_hdbo_searches_its_own_plane_and_reports_clipping():
    search = config("hdbo", task=Task("box", 3.0, 9), embedding_dim=DIM, n_total=14)
    state = runs.run(search, lambda x: bowl(x[:, :4]))
    assert state.u.shape == (2, 14, DIM) and np.all(np.abs(state.u) <= 0.5)
    assert np.all(np.abs(state.x) <= 3.0) and 0.0 < state.clipped.mean() < 1.0
    # points that nothing clipped lie in a plane of dimension 4
    free = state.x[0][state.clipped[0] == 0.0]
    if len(free) > DIM:
        assert np.linalg.matrix_rank(free, tol=1e-8) <= DIM


def test_failing_simulations_are_retried_recorded_and_survived():
    calls = []

    def shaky(x):
        calls.append(len(x))
        specs, status = bowl(x)
        specs[x[:, 0] > 1.0] = np.nan  # never converges there
        if len(calls) == 3:
            raise RuntimeError("licence server away")
        return specs, status

    state = runs.run(config(n_total=14), shaky)
    assert state.y.shape == (2, 14)
    bad = state.x[:, :, 0] > 1.0
    np.testing.assert_array_equal(np.isnan(state.y), bad)
    np.testing.assert_array_equal(state.status != 0, bad)
    # two seeds at a time, one more call for what failed, and point by point after a raise
    assert calls[0] == 16 and 0 < calls[1] < 16 and calls[2:5] == [2, 1, 1]


def test_user_data_start_a_search_and_bad_rows_are_named():
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, (10, DIM))
    y = bowl(x)[0][:, 0]
    state = runs.start_from(config(), x, y)
    end = runs.run(config(n_total=12), bowl, state=state)
    np.testing.assert_array_equal(end.x[1, :10], x)
    assert end.n == 12
    for row, value, message in ((3, np.nan, "row 3: not finite"), (5, 3.5, "row 5: 3.5 sigma")):
        broken = x.copy()
        broken[row, 0] = value
        with pytest.raises(ValueError, match=message):
            runs.start_from(config(), broken, y)
    with pytest.raises(ValueError, match="random embedding"):
        runs.start_from(config("hdbo"), x, y)
    with pytest.raises(ValueError, match=r"expected \[n, 4\]"):
        runs.start_from(config(), x[:, :2], y)


def test_ask_and_tell_by_hand():
    search = config("monte_carlo", n_total=60)
    state = bayesopt.init(search)
    with pytest.raises(ValueError, match="call ask first"):
        bayesopt.tell(search, state, np.zeros((2, 1)))
    x, state = bayesopt.ask(search, state)
    again, state = bayesopt.ask(search, state)
    np.testing.assert_array_equal(x, again)
    with pytest.raises(ValueError, match=r"expected \(2, 50\)"):
        bayesopt.tell(search, state, np.zeros((2, 1)))
    state = bayesopt.tell(search, state, np.zeros((2, 50)))
    x, state = bayesopt.ask(search, state)
    assert x.shape == (2, 10, DIM)
    state = bayesopt.tell(search, state, np.full((2, 10), np.inf))
    assert np.all(state.status[:, 50:] == -1)
    with pytest.raises(ValueError, match="n_total=60: expected more than the 60 simulations"):
        bayesopt.ask(search, state)


def test_bad_configurations_say_what_is_known():
    with pytest.raises(ValueError, match="known methods: monte_carlo, ridge_corner"):
        config("hyperband")
    with pytest.raises(ValueError, match="expected 'box' or 'ball'"):
        config(task=Task("cube", 3.0, DIM))
    with pytest.raises(ValueError, match="all different"):
        config(seeds=(1, 1))
    with pytest.raises(ValueError, match="embedding_dim=9"):
        config("hdbo", embedding_dim=9)
    with pytest.raises(ValueError, match="n_init=50, n_total=10"):
        config(n_init=50, n_total=10)
    assert dataclasses.replace(config("pbo")).acquisition.batch_size == 5


def test_the_callers_precision_is_left_alone(full_run):
    assert full_run.x.dtype == np.float64
    assert jax.numpy.zeros(()).dtype == np.float32


def test_hyper_parameters_are_fitted_to_a_part_of_many_points():
    from failure.search.surrogates import FIT_POINTS, fit_rows

    y = np.stack([np.arange(1000.0), -np.arange(1000.0)])
    y[0, 999] = np.nan
    rows = fit_rows(y)
    assert rows.shape == (2, FIT_POINTS)
    assert all(len(set(r)) == FIT_POINTS for r in rows.tolist())
    # the largest outputs are there, the invalid one is the last choice, the rest is spread
    assert set(range(900, 999)) <= set(rows[0]) and set(range(100)) <= set(rows[1])
    assert np.diff(rows[1]).max() < 8
    np.testing.assert_array_equal(fit_rows(y[:, :50])[1], np.arange(50))
