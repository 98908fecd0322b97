"""Axes as they are written, the leaves they name, and the designs made of them."""

from __future__ import annotations

import doctest
import importlib

import numpy as np
import pytest

from jaxsnn.presets import preset
from snn_fusion_failure.sweeps import axes
from snn_fusion_failure.sweeps.axes import Axis, parse_axis
from snn_fusion_failure.sweeps.designs import design, digest
from snn_fusion_failure.sweeps.leaves import batch, leaf_names, resolve
from snn_fusion_failure.sweeps.study import load_study, parse_options, parse_pairs
from tests.snn_fusion_failure.sweep_toy import NAME, Toy

KNOWN = ("gamma", "stdp.tau_z", "reward.k", "hidden.tau_m", "output.tau_m")


def unit(leaf: str) -> str:
    return "ms" if "tau" in leaf else ""


def axis(text: str) -> Axis:
    return parse_axis(text, lambda name: (resolve(name, KNOWN), "float", None), unit)


def test_values_and_ranges() -> None:
    assert axis("tau_z=5,25,100") == Axis("stdp.tau_z", "ms", values=(5.0, 25.0, 100.0))
    np.testing.assert_allclose(axis("gamma=1e-4:1e-1:log:16").values, np.geomspace(1e-4, 0.1, 16))
    assert axis("gamma=1e-4:1e-1:log:4").values == (1e-4, 1e-3, 1e-2, 1e-1)
    assert axis("reward.k=0:2:lin:5").values == axis("k=0:2:5").values == (0, 0.5, 1, 1.5, 2)
    assert axis("params.gamma=1:2") == Axis("gamma", low=1.0, high=2.0)
    assert axis("k=1:4:int") == Axis("reward.k", kind="int", low=1, high=4)
    assert axis("k=1:64:log:int:3").values == (1, 8, 64)


def test_units_are_converted_once_each_way() -> None:
    assert axis("tau_z=25,0.1s,7us").values == (25.0, 100.0, 0.007)
    with pytest.raises(ValueError, match="twice"):
        axis("tau_z=25ms,0.025s")
    tree = batch(Toy(), {"inner.time": np.array([25.0, 50.0])}, 2, {"inner.time": "ms"}, "float64")
    assert tree.inner.time.tolist() == [0.025, 0.05]
    assert tree.a.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gama=1,2", r"'gama' is no leaf of this study \(did you mean gamma\?\); .*stdp.tau_z"),
        ("tau_m=5,10", "names several leaves: hidden.tau_m, output.tau_m"),
        ("gamma", "expected leaf=values"),
        ("gamma=", "expected leaf=values"),
        ("gamma=1,x", "'x' is not a finite number"),
        ("gamma=nan", "'nan' is not a finite number"),
        ("gamma=5ms", "unit 'ms' does not fit; it has no unit"),
        ("tau_z=5Hz", "unit 'Hz' does not fit; expected s or ms or us or ns"),
        ("gamma=2:1:4", "2 is not below 1"),
        ("gamma=0:1:log:4", "starts above 0"),
        ("gamma=1:2:1", "give at least 2"),
        ("gamma=1:2:cubic:3", "expected low:high"),
        ("gamma=1:2:log:3:4", "expected low:high"),
    ],
)
def test_what_cannot_be_read_is_named(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        axis(text)


def test_every_leaf_of_a_network_can_be_named() -> None:
    _, params = preset("S4")
    names = leaf_names(params)
    assert {"gamma", "stdp.tau_z", "reward.k", "hidden.tau_m", "homeostasis"} <= set(names)
    for place, name in enumerate(names):
        filled = batch(params, {name: np.array([0.5])}, 1, {}, "float32")
        changed = [n for n, x in zip(names, _flat(filled), strict=True) if x[0] == 0.5]
        assert name in changed
        assert resolve(name, names) == names[place]


def _flat(tree):
    import jax

    return jax.tree.leaves(tree)


def test_grid_is_the_product() -> None:
    made = design("grid", [axis("k=1,2"), axis("gamma=3,4,5")])
    assert made.shape == (2, 3)
    assert made.rows == ((1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5))
    with pytest.raises(ValueError, match=r"a grid needs a count, 1:2:lin:N"):
        design("grid", [axis("k=1:2")])
    with pytest.raises(ValueError, match=r"reward\.k is given twice"):
        design("grid", [axis("k=1,2"), axis("reward.k=3")])
    with pytest.raises(ValueError, match="no axis"):
        design("grid", [])


@pytest.mark.parametrize("kind", ["random", "sobol"])
def test_samples(kind) -> None:
    drawn = [axis("gamma=1e-4:1e-1:log"), axis("tau_z=5,25,100"), axis("k=-1:1")]
    made = design(kind, drawn, samples=64, seed=1)
    again = design(kind, drawn, samples=24, seed=1)
    assert made.rows[:24] == again.rows  # a longer one goes on
    assert made.rows != design(kind, drawn, samples=64, seed=2).rows
    gamma, tau, k = np.asarray(made.rows).T
    assert set(tau) == {5.0, 25.0, 100.0}
    assert (gamma >= 1e-4).all() and (gamma <= 0.1).all() and (np.abs(k) <= 1).all()
    # log-uniform: a third per decade, to within sampling (Sobol: exactly balanced to one or two)
    share = [np.mean((gamma >= lo) & (gamma < 10 * lo)) for lo in (1e-4, 1e-3, 1e-2)]
    np.testing.assert_allclose(share, 1 / 3, atol=0.16 if kind == "random" else 0.03)
    with pytest.raises(ValueError, match="needs --samples"):
        design(kind, drawn)


def test_every_value_of_a_grid_axis_meets_every_sample() -> None:
    space = [
        axes.loguniform(1e-5, 1e-2)._replace(leaf="gamma"),
        axes.choice(32, 64)._replace(leaf="width"),
        axes.grid(5, 25, 100)._replace(leaf="tau_z"),
    ]
    made = design("sobol", space, samples=16)
    assert made.n == 16 * 3
    gamma, width, tau = zip(*made.rows, strict=True)
    assert len(set(gamma)) == 16 and set(width) == {32, 64}
    assert [tau.count(v) for v in (5.0, 25.0, 100.0)] == [16, 16, 16]


def test_whole_numbers_are_drawn_evenly_ends_included() -> None:
    whole = axes.integers(1, 4)._replace(leaf="depth")
    rows = design("sobol", [whole, whole._replace(leaf="b")], samples=64).rows
    # Sixteen cells, which share 64 points of a Sobol sequence evenly, a few drawn twice.
    assert {row[0] for row in rows} == {row[1] for row in rows} == {1, 2, 3, 4}
    assert len(rows) == len(set(rows)) == 16
    assert design("grid", [whole]).rows == ((1,), (2,), (3,), (4,))
    for value in (1, 2, 3, 4):
        assert whole.at(np.array([whole.share_of(value)])) == [value]


def test_a_setting_is_known_by_its_values() -> None:
    assert digest(["a"], [1]) == digest(["a"], [1.0])
    assert digest(["a"], [1.0]) != digest(["b"], [1.0])
    assert digest(["a"], ["1"]) != digest(["a"], [1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: axes.choice(), "expected values"),
        (lambda: axes.choice("S3", "S3"), "has a value twice"),
        (lambda: axes.choice([1, 2], 3), "expected a number, a word"),
        (lambda: axes.grid(1.0, float("nan")), "expected finite numbers"),
        (lambda: axes.uniform(2, 1), "low below high"),
        (lambda: axes.loguniform(0, 1), "starts above 0"),
        (lambda: design("grid", [axes.grid(1)._replace(leaf="a")], samples=3), "expected none in"),
        (lambda: design("sobol", [axes.grid(1)._replace(leaf="a")], samples=3), "leave samples"),
        (lambda: design("tpe", [axes.uniform(0, 1)._replace(leaf="a"),
                                axes.grid(1)._replace(leaf="b")], samples=3), "draws all axes"),
        (lambda: design("latin", [axes.grid(1)._replace(leaf="a")]), "expected one of grid"),
    ],
)  # fmt: skip
def test_axes_that_make_no_sense_are_refused(make, message) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_options_of_a_study() -> None:
    study = load_study(NAME, ["length=7"])
    assert study.options["length"] == 7 and study.name == NAME
    assert study.leaves == ("a", "inner.b", "inner.time")
    with pytest.raises(ValueError, match=r"option 'lenght=7' .*length=4"):
        load_study(NAME, ["lenght=7"])
    with pytest.raises(ValueError, match="'x' is no int"):
        load_study(NAME, ["length=x"])
    with pytest.raises(ValueError, match="expected one of snn, argate, failure, lif"):
        load_study("sn")
    with pytest.raises(ValueError, match="function that can be imported"):
        load_study("no.such.module:make")
    changes = parse_options(["changes=params.gamma=1,config.dt=2"], {"changes": []}, "snn")
    assert changes == {"changes": ["params.gamma=1", "config.dt=2"]}
    assert parse_pairs(["timeout_min=5", "slurm_partition=cpu"], "slurm") == {
        "timeout_min": 5,
        "slurm_partition": "cpu",
    }
    with pytest.raises(ValueError, match="expected name=value"):
        parse_pairs(["x"], "slurm")


@pytest.mark.relaxed
@pytest.mark.parametrize(
    "name", ["leaves", "axes", "designs", "study", "program", "rungs", "rank", "results", "engine",
             "front"]
)  # fmt: skip
def test_examples(name, capsys) -> None:
    module = importlib.import_module(f"snn_fusion_failure.sweeps.{name}")
    result = doctest.testmod(module)
    assert result.attempted > 0 and result.failed == 0, capsys.readouterr().out
