"""Run folders: complete identity, growth, damaged files, shapes at the simulator's border."""

import json

import numpy as np
import pytest

from failure.search import runs
from failure.search.methods import SearchConfig
from failure.search.storage import identity_of, samples
from failure.search.task import Task
from failure.search.trees import load_tree, save_tree
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


def test_a_point_that_raises_leaves_its_neighbours_alone_and_says_why(tmp_path):
    def picky(x):
        if np.any(x[:, 0] > 1.0):
            raise RuntimeError("singular matrix")
        return two(x)

    state = runs.run(config(4), picky, folder=tmp_path)
    bad = state.x[:, :, 0] > 1.0
    assert 0 < bad.sum() < bad.size
    np.testing.assert_array_equal(np.isnan(state.y), bad)
    assert set(state.status[bad]) == {Status.FAILED}
    line = json.loads((tmp_path / "evaluations.jsonl").read_text().splitlines()[0])
    assert set(line["messages"]) == {str(k) for k in np.flatnonzero(bad.reshape(-1))}
    assert "RuntimeError: singular matrix" in line["messages"].values()


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
