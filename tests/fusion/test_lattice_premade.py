"""Calibrated models and estimators: constraints hold for the whole model, fits are as good."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.lattice import LatticeClassifier, LatticeRegressor, premade, project_tree
from fusion.lattice.premade import CalibratedConfig, Feature
from fusion.lattice.quantiles import quantile_keypoints
from fusion.lattice.tagged import tag

pytestmark = pytest.mark.relaxed  # optax promotes types
FEATURES = (
    Feature("falls", -1, keypoints=(0.0, 0.3, 1.0)),
    Feature("class", n_categories=4, order=((0, 2), (2, 3))),
    Feature("free", keypoints=(-1.0, 0.0, 2.0)),
)
KINDS = {"linear": (), "lattice": (), "ensemble": ((0, 1), (1, 2), (0, 2))}


@pytest.mark.parametrize("kind", KINDS)
def test_directions_and_orders_hold_for_the_whole_model(kind: str) -> None:
    config = CalibratedConfig(FEATURES, kind, KINDS[kind], output_range=(-2.0, 5.0), missing=True)
    rng = np.random.default_rng(0)
    start = jax.jit(lambda key: premade.init(key, config))(jax.random.key(0))
    noisy = jax.tree.map(lambda a: a + jnp.asarray(rng.normal(size=a.shape), a.dtype), start)
    params = jax.jit(lambda p: project_tree(tag(config, p)).value)(noisy)
    check = jax.jit(lambda p: premade.check(config, p))
    assert float(check(start)) == float(check(params)) == 0.0 < float(check(noisy))
    apply = jax.jit(lambda x: premade.apply(config, params, x))
    base = np.stack([rng.uniform(0, 1, 40), rng.integers(0, 4, 40), rng.normal(size=40)], 1)
    rows = np.repeat(base[:, None], 11, axis=1)
    rows[..., 0] = np.linspace(-0.2, 1.2, 11)
    y = np.asarray(apply(jnp.asarray(rows, jnp.float32)))
    assert np.diff(y, axis=1).max() <= 1e-6 and np.ptp(y) > 1e-3
    assert y.min() >= -2.0 - 1e-6 and y.max() <= 5.0 + 1e-6
    rows = np.repeat(base[:, None], 3, axis=1)
    rows[..., 1] = [0, 2, 3]
    assert np.diff(np.asarray(apply(jnp.asarray(rows, jnp.float32))), axis=1).min() >= -1e-6
    rows[:, 0, 2] = np.nan
    assert np.isfinite(np.asarray(apply(jnp.asarray(rows, jnp.float32)))).all()


@pytest.mark.slow
def test_a_regressor_learns_a_monotone_surface_and_keeps_it() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0.0, 1.0, (400, 2))
    y = 100.0 + 20.0 * x[:, 0] ** 2 * (0.5 + x[:, 1])
    model = LatticeRegressor((Feature("a", 1), Feature("b")), n_keypoints=6, epochs=60)
    assert model.fit(x[:300], y[:300]) is model
    assert model.score(x[300:], y[300:]) > 0.97
    line = np.stack([np.linspace(0, 1, 50), np.full(50, 0.3)], 1)
    assert np.diff(model.predict(line)).min() >= -1e-4
    assert float(premade.check(model.config_, model.params_)) == 0.0
    copy = LatticeRegressor(**model.get_params()).set_params(epochs=1)
    assert copy.epochs == 1 and model.epochs == 60
    with pytest.raises(ValueError, match="set_params='epoch': expected one of"):
        copy.set_params(epoch=1)


def test_bad_data_is_named() -> None:
    x = np.zeros((4, 2))
    for call, message in [
        (lambda: LatticeRegressor().predict(x), "call fit"),
        (lambda: LatticeRegressor().fit(x[0], x[:, 0]), "X.shape"),
        (lambda: LatticeRegressor().fit(x, np.zeros(3)), "4 finite numbers"),
        (lambda: LatticeRegressor((Feature("a"),)).fit(x, x[:, 0]), "1 columns"),
        (lambda: LatticeClassifier().fit(x, np.zeros(4)), "two classes"),
        (lambda: Feature("a", 1, n_categories=3), "0 for categories"),
        (lambda: CalibratedConfig(FEATURES, "ensemble"), "subsets for an ensemble"),
        (lambda: quantile_keypoints(np.full((3, 1), np.nan)), "finite number in each column"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


def test_quantiles_share_the_data_and_increase() -> None:
    rng = np.random.default_rng(2)
    data = np.stack([rng.exponential(size=1000), rng.integers(0, 3, 1000), np.full(1000, 7.0)], 1)
    data[:5, 0] = np.nan
    places = np.asarray(quantile_keypoints(data, 6))
    assert (np.diff(places, axis=1) > 0).all()
    counts = np.histogram(data[5:, 0], places[0])[0]
    np.testing.assert_allclose(counts, 199, atol=2)
    assert set(places[1]) >= {0.0, 1.0, 2.0}
