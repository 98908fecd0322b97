"""Constraints between inputs in ensembles and calibrated models: they hold for the whole model."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.lattice import LatticeRegressor, ensemble, premade
from fusion.lattice.ensemble import EnsembleConfig
from fusion.lattice.features import Feature, related_positions, together
from fusion.lattice.premade import CalibratedConfig
from fusion.lattice.subsets import random_features

SIGNS = (1, 1, 0, 0, 1, 0, 0)
RELATED = EnsembleConfig(
    7,
    random_features(0, 7, 3, 5, together=((0, 1), (2, 3), (4, 5))),
    2,
    SIGNS,
    edgeworth_trust=((0, 2, 1),),
    trapezoid_trust=((4, 5, -1),),
    dominance=((0, 1),),
    joint_monotonicity=((2, 3, 1),),
)


def _noisy(module: Any, config: Any, seed: int = 0) -> Any:
    start = module.init(jax.random.key(seed), config)
    rng = np.random.default_rng(seed)
    noise = jax.tree.map(lambda a: a + jnp.asarray(0.3 * rng.normal(size=a.shape), a.dtype), start)
    assert float(module.check(config, start)) == 0.0 < float(module.check(config, noise))
    return jax.jit(lambda p: module.project(config, p))(noise)


def _points(n: int, width: int, top: float) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.0, top, (n, width)).astype(np.float32)


def test_an_ensemble_keeps_each_constraint_as_a_whole() -> None:
    params = _noisy(ensemble, RELATED)
    assert float(ensemble.check(RELATED, params)) == 0.0
    f = jax.jit(lambda x: ensemble.apply(RELATED, params, x))
    x, unit = _points(300, 7, 0.95), np.eye(7, dtype=np.float32)

    def at(**places: float) -> np.ndarray:
        moved = x.copy()
        for name, value in places.items():
            moved[:, int(name[1:])] = value
        return np.asarray(f(moved))

    slopes = np.asarray(jax.vmap(jax.grad(lambda row: f(row[None])[0]))(x))
    assert slopes[:, [0, 1, 4]].min() >= -1e-6 and np.abs(slopes).max() > 0.1
    assert (slopes[:, 0] - slopes[:, 1]).min() >= -1e-6
    # The whole cell: trust and joint monotonicity are about steps from vertex to vertex.
    mixed = (at(x0=1, x2=1) - at(x0=0, x2=1)) - (at(x0=1, x2=0) - at(x0=0, x2=0))
    assert mixed.min() >= -1e-6 and mixed.max() > 1e-3
    wide, narrow = at(x4=1, x5=0) - at(x4=0, x5=0), at(x4=1, x5=1) - at(x4=0, x5=1)
    assert (wide - narrow).min() >= -1e-6
    assert (at(x4=0, x5=1) - at(x4=0, x5=0)).min() >= -1e-6
    both = np.clip(x + 0.05 * (unit[2] + unit[3]), 0, 1)
    assert (np.asarray(f(both)) - np.asarray(f(x))).min() >= -1e-6


def test_a_lattice_that_would_speak_against_a_constraint_is_refused() -> None:
    refused: tuple[tuple[str, Any, tuple[int, int]], ...] = (
        ("dominance", (0, 1), (1, 2)),
        ("range_dominance", (0, 1), (1, 2)),
        ("trapezoid_trust", (0, 2, 1), (2, 3)),
        ("joint_monotonicity", (2, 3, 1), (0, 3)),
        ("joint_unimodality", ((2, 3), 1), (0, 2)),
    )
    for name, entry, bad in refused:
        relation: dict[str, Any] = {name: (entry,)}
        with pytest.raises(ValueError, match=f"{name}=.*in each subset that holds one of"):
            EnsembleConfig(4, ((0, 1), bad), 3, (1, 1, 0, 0), **relation)
    # One that holds the other inputs only does not.
    EnsembleConfig(4, ((0, 1), (0, 3)), 3, (1, 1, 0, 0), dominance=((0, 1),))
    EnsembleConfig(4, ((0, 1), (2, 3)), 3, (1, 1, 0, 0), edgeworth_trust=((0, 2, 1),))
    with pytest.raises(ValueError, match=r"different inputs of 0\.\.3"):
        EnsembleConfig(4, ((0, 1), (2, 3)), 3, (1, 1, 0, 0), dominance=((0, 4),))


def test_random_subsets_hold_groups_together() -> None:
    subsets = random_features(3, 9, 7, 4, together=((0, 1), (1, 2), (5, 6)))
    assert all(len(set(s)) == 4 for s in subsets) and set().union(*subsets) == set(range(9))
    for group in ({0, 1, 2}, {5, 6}):
        assert all(group <= set(s) or not group & set(s) for s in subsets)
    assert random_features(3, 9, 7, 4) == random_features(3, 9, 7, 4, together=((4,),))
    with pytest.raises(ValueError, match="groups that fill subsets of 3 inputs"):
        random_features(0, 4, 2, 3, together=((0, 1), (2, 3)))
    with pytest.raises(ValueError, match=r"together=\(0, 9\): expected inputs of 0\.\.3"):
        random_features(0, 4, 2, 2, together=((0, 9),))


FEATURES = (
    Feature("main", 1, keypoints=(0.0, 0.2, 1.0)),
    Feature("age", -1, keypoints=(0.0, 0.7, 1.0)),
    Feature("weak", 1, keypoints=(0.0, 0.5, 1.0)),
)
RELATIONS = (("edgeworth_trust", "main", "age", 1), ("dominance", "main", "weak"))


@pytest.mark.parametrize("kind", ["lattice", "ensemble"])
def test_a_calibrated_model_trusts_more_where_the_feature_is_larger(
    kind: Literal["lattice", "ensemble"],
) -> None:
    subsets = ((0, 1), (0, 2)) if kind == "ensemble" else ()
    config = CalibratedConfig(FEATURES, kind, subsets, 2, n_output_keypoints=2, relations=RELATIONS)
    params = _noisy(premade, config)
    assert float(premade.check(config, params)) == 0.0
    x = _points(200, 3, 1.0)
    f = jax.jit(lambda rows: premade.apply(config, params, rows))

    def rise(age: float) -> np.ndarray:
        rows = [x.copy(), x.copy()]
        for row, main in zip(rows, (0.1, 0.9), strict=True):
            row[:, 0], row[:, 1] = main, age
        low, high = (np.asarray(f(jnp.asarray(row))) for row in rows)
        return high - low

    # The model falls with age, and yet its effect of `main` grows with it.
    gain = rise(0.9) - rise(0.1)
    assert gain.min() >= -1e-6 and gain.max() > 1e-3
    old = np.asarray(f(jnp.array([[0.5, 0.9, 0.5]])))
    young = np.asarray(f(jnp.array([[0.5, 0.1, 0.5]])))
    assert old[0] <= young[0] + 1e-6


def test_a_linear_model_has_dominances_and_says_what_it_has_not() -> None:
    config = CalibratedConfig(FEATURES, "linear", relations=RELATIONS[1:])
    weights = _noisy(premade, config).body.weights
    assert weights[0, 0] >= weights[0, 2] >= 0
    for bad, message in (
        (
            {"kind": "linear", "relations": RELATIONS, "n_output_keypoints": 2},
            "dominance or range_dom",
        ),
        ({"relations": RELATIONS}, "set n_output_keypoints=2"),
        ({"relations": (("dominance", "main", "wek"),)}, "not 'wek'"),
        ({"relations": (("edgeworth_trust", "main", "weak", 2),)}, "direction -1 or 1"),
        ({"relations": (("domnance", "main", "weak"),)}, "one of edgeworth_trust"),
        ({"relations": (("dominance", "main"),)}, "'dominance', two features"),
        ({"relations": (("dominance", "main", "age", "weak"),)}, "'dominance', two features"),
    ):
        with pytest.raises(ValueError, match=message):
            CalibratedConfig(FEATURES, **bad)


def test_relations_by_name_are_those_by_position() -> None:
    joint = ("joint_unimodality", ("weak", "main"), -1)
    found = related_positions(FEATURES, (*RELATIONS, joint))
    assert found == {
        "edgeworth_trust": ((0, 1, -1),),
        "dominance": ((0, 2),),
        "joint_unimodality": (((2, 0), -1),),
    }
    assert together(FEATURES, (*RELATIONS, joint)) == ((0, 1), (0, 2), (2, 0))


@pytest.mark.relaxed
@pytest.mark.slow
def test_an_estimator_fits_under_relations() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(400, 4))
    y = 2.0 * x[:, 0] + x[:, 2] * (1.0 + x[:, 0]) - x[:, 1]
    features = (*FEATURES, Feature("free"))
    model = LatticeRegressor(
        features, relations=RELATIONS, kind="ensemble", rank=3, n_lattices=4, n_keypoints=4,
        n_output_keypoints=2, epochs=30,
    )  # fmt: skip
    with pytest.raises(ValueError, match="groups that fill subsets of 3 inputs"):
        model.fit(x, y)  # three stay together, and one is left over
    model.set_params(rank=4, n_lattices=2).fit(x, y)
    assert model.score(x, y) > 0.8
    assert float(premade.check(model.config_, model.params_)) == 0.0
