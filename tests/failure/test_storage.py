"""Run folders: complete identity, growth, damaged files, shapes at the simulator's border."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest

from failure.identities import identity_of
from failure.search import runs
from failure.search.methods import SearchConfig
from failure.search.storage import samples
from failure.search.task import Task
from failure.search.trees import load_tree, save_tree
from failure.simulators import SimulatorError
from failure.status import Status

TASK = Task("box", 3.0, 3)


def two(x):
    """Two specifications of a bowl."""
    y = 4.0 - np.sum((np.asarray(x) - 1.0) ** 2, 1)
    return np.stack([y, -y], 1), np.zeros(len(x), int)


def other(x):
    return two(x)


def config(n_total=10, method="ridge_corner", **changes):
    return SearchConfig(TASK, method, seeds=(0, 1), n_init=4, n_total=n_total, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"column": 1}, "column: 0 -> 1"),
        ({"sense": "min"}, "sense: 'max' -> 'min'"),
        ({"simulate": other}, r"simulator: '.*\.two' -> '.*\.other'"),
        ({"identity": "two v2"}, "simulator: .* -> 'two v2'"),
    ],
)
def test_a_folder_answers_only_for_its_own_question(tmp_path, changes, message):
    runs.run(config(), two, folder=tmp_path)
    with pytest.raises(ValueError, match=message):
        runs.run(config(), **{"simulate": two, "folder": tmp_path, **changes})


def test_a_start_is_part_of_the_folder(tmp_path):
    x = np.random.default_rng(0).uniform(-3, 3, (5, 3))
    state = runs.start_from(config(), x, two(x)[0][:, 0])
    counted = []

    def simulate(x):
        counted.append(len(x))
        return two(x)

    end = runs.run(config(), simulate, folder=tmp_path, state=state)
    np.testing.assert_array_equal(end.x[0, :5], x)
    assert sum(counted) == 2 * 5
    again = runs.run(config(), simulate, folder=tmp_path, state=state)
    np.testing.assert_array_equal(again.y, end.y)
    assert sum(counted) == 2 * 5
    with pytest.raises(ValueError, match=r"start: '5 evaluations .*' -> None"):
        runs.run(config(), simulate, folder=tmp_path)


def test_the_budget_grows_in_its_folder(tmp_path):
    runs.run(config(6), two, folder=tmp_path)
    grown = runs.run(config(12), two, folder=tmp_path)
    np.testing.assert_array_equal(grown.x, runs.run(config(12), two).x)
    with pytest.raises(ValueError, match="n_total: 12 -> 6"):
        runs.run(config(6), two, folder=tmp_path)
    cut = runs.run(config(6, "gradient_corner"), two, folder=tmp_path / "g")
    assert cut.n == 6
    cut = runs.run(config(7, "gradient_corner"), two, folder=tmp_path / "h")
    whole = runs.run(config(11, "gradient_corner"), two, folder=tmp_path / "h")
    np.testing.assert_array_equal(whole.x, runs.run(config(11, "gradient_corner"), two).x)


def test_a_folder_may_be_named_by_a_string(tmp_path):
    state = runs.run(config(), two, folder=str(tmp_path / "run"))
    assert runs.load(config(), str(tmp_path / "run")).n == state.n


@pytest.mark.parametrize(
    "damage", [b'{"n": 6, "x": [[\n', b"\xe9t\xe9\n", b"\n", b'{"n": 99}\n'], ids=repr
)
def test_a_damaged_line_is_named_set_aside_and_simulated_again(tmp_path, damage):
    whole = runs.run(config(), two, folder=tmp_path)
    log = tmp_path / "evaluations.jsonl"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join([*lines[:2], damage, *lines[3:]]))
    with pytest.warns(RuntimeWarning, match=r"evaluations\.jsonl: line 3 cannot be read"):
        again = runs.run(config(), two, folder=tmp_path)
    np.testing.assert_array_equal(again.x, whole.x)
    assert (tmp_path / "evaluations.jsonl.damaged").exists()
    assert log.read_bytes().splitlines() == [line.rstrip() for line in lines]


def test_empty_settings_and_trees_are_made_again(tmp_path):
    whole = runs.run(config(), two, folder=tmp_path)
    (tmp_path / "search.json").write_bytes(b"")
    with pytest.warns(RuntimeWarning, match=r"search\.json: .*; kept as search\.json\.damaged"):
        again = runs.run(config(), two, folder=tmp_path)
    np.testing.assert_array_equal(again.x, whole.x)
    assert json.loads((tmp_path / "search.json").read_text())["sense"] == "max"
    (tmp_path / "search.json").write_bytes(b"\xe9")
    with pytest.raises(ValueError, match="the log beside it belongs to other settings"):
        runs.run(config(), two, column=1, folder=tmp_path)
    (tmp_path / "space.npz").write_bytes(b"")
    with pytest.warns(RuntimeWarning, match=r"space\.npz: .*computed again"):
        assert load_tree(tmp_path / "space.npz") is None


def test_a_folder_of_an_earlier_version_is_refused_and_its_samples_can_be_used(tmp_path):
    runs.run(config(), two, folder=tmp_path)
    held = json.loads((tmp_path / "search.json").read_text())
    for name in ("format", "column", "sense", "simulator", "start"):
        del held[name]
    (tmp_path / "search.json").write_text(json.dumps(held))
    with pytest.raises(ValueError, match=r"earlier version.*start_from"):
        runs.run(config(), two, folder=tmp_path)
    x, y = samples(tmp_path)
    assert x.shape == (20, 3) and y.shape == (20,)


def test_spaces_are_saved_by_the_names_of_their_fields(tmp_path):
    import jax.numpy as jnp

    from failure import bnn, revnet
    from failure.search.spaces import ReversedFeatures

    pair = (jnp.ones(2), jnp.zeros(1), jnp.ones(3), jnp.zeros(4))
    one = jnp.ones(1)
    restoration = bnn.BNNParams(pair, pair, one, one, one, one, one)
    network = revnet.RevNetParams(one, one, one, one, 2.0 * one)
    for rest in (None, restoration):
        space = ReversedFeatures(network, jnp.arange(3), one, one, one, rest)
        save_tree(tmp_path / "space.npz", space, 7)
        names = set(np.load(tmp_path / "space.npz").files)
        assert {"tree.network.step", "tree.order", "at", "kind"} <= names
        found, at = load_tree(tmp_path / "space.npz")
        assert at == 7 and isinstance(found, ReversedFeatures)
        assert float(found.network.step[0]) == 2.0
        assert (found.restoration is None) == (rest is None)
        if rest is not None:
            np.testing.assert_array_equal(found.restoration.log_sd[3], np.zeros(4))


def test_fewer_rows_than_points_are_refused():
    def short(x):
        specs, status = two(x)
        return specs[:1], status[:1]

    with pytest.raises(ValueError, match=r"specs.shape=\(1, 2\), status.shape=\(1,\): expected"):
        runs.run(config(), short)
    with pytest.raises(ValueError, match=r"status.shape=\(8, 1\)"):
        runs.run(config(), lambda x: (two(x)[0], np.zeros((len(x), 1))))
    with pytest.raises(ValueError, match=r"column=2: expected 0 \.\.\. 1"):
        runs.run(config(), two, column=2)
    with pytest.raises(ValueError, match="sense='mni'"):
        runs.run(config(), two, sense="mni")


class LicenceError(Exception):
    """An error that no library knows."""


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("singular matrix"),
        np.linalg.LinAlgError("singular matrix"),
        ValueError("no operating point"),
        KeyError("vdd"),
        TypeError("unsupported operand"),
        AssertionError("mesh"),
        StopIteration("end of file"),
        LicenceError("none left"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_point_that_raises_leaves_its_neighbours_alone_and_says_why(tmp_path, error):
    def picky(x):
        if np.any(x[:, 0] > 1.0):
            raise error
        return two(x)

    state = runs.run(config(4), picky, folder=tmp_path)
    bad = state.x[:, :, 0] > 1.0
    assert 0 < bad.sum() < bad.size
    np.testing.assert_array_equal(np.isnan(state.y), bad)
    assert set(state.status[bad]) == {Status.FAILED}
    line = json.loads((tmp_path / "evaluations.jsonl").read_text().splitlines()[0])
    assert set(line["messages"]) == {str(k) for k in np.flatnonzero(bad.reshape(-1))}
    assert f"{type(error).__name__}: {error}" in line["messages"].values()


@pytest.mark.parametrize("error", [SimulatorError("no licence"), KeyboardInterrupt()])
def test_what_ends_the_simulator_ends_the_search(error):
    calls = []

    def ended(x):
        calls.append(len(x))
        raise error

    with pytest.raises(type(error)):
        runs.run(config(), ended)
    assert calls == [8]


def raising(x):
    raise np.linalg.LinAlgError("singular matrix")


def nothing(x):
    return np.full((len(x), 2), np.nan), np.zeros(len(x), int)


def failing(x):
    return np.zeros((len(x), 2)), np.full(len(x), int(Status.TIMED_OUT))


@pytest.mark.parametrize("method", ["ridge_corner", "gradient_corner", "full"])
@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (raising, "never worked; its last message: LinAlgError: singular matrix"),
        (nothing, r"never worked; .* status -1 \(not finite output\)"),
        (failing, r"never worked; .* status 2 \(timed out\)"),
    ],
)
def test_a_simulator_that_never_works_stops_after_the_initial_design(
    tmp_path, simulate, message, method
):
    for _ in range(2):
        # The second time with what the log tells; a simulator that works by then goes on.
        with pytest.raises(SimulatorError, match=message):
            runs.run(config(30, method), simulate, folder=tmp_path, retries=0, identity="mine")
    x = [np.array(r["x"]) for r in runs.storage.read_log(tmp_path)]
    assert 8 <= sum(block[..., 0].size for block in x) < 60
    if method == "ridge_corner":
        state = runs.run(config(30, method), two, folder=tmp_path, identity="mine")
        assert np.isfinite(state.y).any()


def test_a_spent_budget_without_a_valid_point_is_an_error_every_time(tmp_path):
    for _ in range(2):
        with pytest.raises(SimulatorError, match=r"failed 8 times .* LinAlgError: singular"):
            runs.run(config(4), raising, folder=tmp_path)


def test_samples_of_ones_own_do_not_hide_a_simulator_that_never_works():
    x = np.random.default_rng(0).uniform(-3, 3, (5, 3))
    state = runs.start_from(config(), x, two(x)[0][:, 0])
    with pytest.raises(SimulatorError, match="LinAlgError: singular matrix"):
        runs.run(config(30), raising, state=state)


def test_one_valid_point_and_declared_failures_go_on():
    """NaN that the simulator calls a failure of a given size is a value like any other."""
    state = runs.run(config(9), lambda x: (np.nan_to_num(nothing(x)[0], nan=1.0), nothing(x)[1]))
    assert state.n == 9 and np.all(state.y == 1.0)

    def once(x):
        specs, status = nothing(x)
        if len(x) == 8:
            specs[3] = 0.5
        return specs, status

    state = runs.run(config(9), once)
    assert state.n == 9 and np.isfinite(state.y).sum() == 1


def test_messages_of_corners_reach_the_log(tmp_path):
    class Netlist:
        def __init__(self):
            self.messages = {(1, "hot"): "no number for gain", (1, "cold"): "no number for vout"}

        def __call__(self, x):
            specs, status = two(x)
            return specs, np.where(np.arange(len(x)) == 1, int(Status.NOT_FINITE), status)

    runs.run(config(4), Netlist(), folder=tmp_path, retries=0)
    line = json.loads((tmp_path / "evaluations.jsonl").read_text().splitlines()[0])
    assert line["messages"] == {
        "1": "corner hot: no number for gain; corner cold: no number for vout"
    }


def test_outputs_as_small_as_femtoamperes_are_searched_like_volts():
    def scaled(factor):
        def simulate(x):
            specs, status = two(x)
            return factor * specs, status

        return simulate

    small = runs.run(config(9), scaled(1e-15))
    large = runs.run(config(9), scaled(1.0))
    np.testing.assert_allclose(small.x, large.x, rtol=1e-6)


def test_identities_of_simulators():
    class Circuit:
        name = "ldo"

        def simulate(self, x):
            return two(x)

    assert identity_of(Circuit().simulate) == "Circuit ldo"
    assert identity_of(two).endswith(".two")


def scaled(x, factor=1.0, weights=None, **options):
    specs, status = two(x)
    return factor * specs, status


@dataclasses.dataclass(frozen=True)
class Setting:
    vdd: float
    weights: np.ndarray


class Technology:
    """Something without a text of its own."""


def test_partials_are_known_by_function_and_arguments(tmp_path):
    hot, cold = np.arange(3.0), np.arange(3.0) + 1e-9
    kinds = [
        partial(scaled, factor=2.0),
        partial(scaled, factor=2.5),
        partial(other),
        partial(scaled, weights=hot),
        partial(scaled, weights=cold),
        partial(scaled, weights=[1, "a", None, hot]),
        partial(scaled, weights=[1, "a", None, cold]),
        partial(scaled, weights=Setting(1.8, hot)),
        partial(scaled, weights=Setting(1.8, cold)),
        partial(scaled, weights=two),
        partial(scaled, weights=other),
        partial(scaled, weights=Technology()),
        partial(partial(scaled, factor=2.0), weights={"a": hot}),
        partial(partial(scaled, factor=2.0), weights={"a": cold}),
    ]
    names = [identity_of(kind) for kind in kinds]
    assert len(set(names)) == len(names)
    assert not [name for name in names if " at 0x" in name]
    assert identity_of(partial(scaled, b=1, a=hot)) == identity_of(partial(scaled, a=hot, b=1))
    runs.run(config(), partial(scaled, factor=2.0), folder=tmp_path)
    runs.run(config(12), partial(scaled, factor=2.0), folder=tmp_path)
    with pytest.raises(ValueError, match=r"simulator: '.*factor=2.0\)' -> '.*factor=3.0\)'"):
        runs.run(config(12), partial(scaled, factor=3.0), folder=tmp_path)


def test_no_name_is_not_the_name_of_another_simulator(tmp_path):
    class Unnamed:
        identity = ""

        def __call__(self, x):
            return two(x)

    assert identity_of(Unnamed()).endswith("Unnamed")
    with pytest.raises(ValueError, match="identity='': expected a name of the simulator"):
        runs.run(config(), two, folder=tmp_path, identity="")
