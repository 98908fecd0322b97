import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import bnn

CONFIG = bnn.BNNConfig(hidden=8, steps=1500)


@pytest.fixture(scope="module")
def nuts(golden):
    record = json.loads((golden / "failure_bnn.json").read_text())
    return {k: np.asarray(v, np.float32) for k, v in record.items() if isinstance(v, list)}


@pytest.fixture(scope="module")
def fitted(nuts):
    fit = jax.jit(bnn.fit, static_argnums=0)
    return fit(
        CONFIG, bnn.BNNTrainParams(), jnp.asarray(nuts["x"]), jnp.asarray(nuts["y"]),
        key=jax.random.key(0),
    )  # fmt: skip


def truth(x):
    return np.stack([np.sin(1.5 * x[:, 0]) + 0.3 * x[:, 1], x[:, 1] * x[:, 2]], 1)


def rmse(a, b):
    return float(np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)))


def test_training_lowers_the_bound(fitted):
    _, losses = fitted
    assert losses[-50:].mean() < losses[:50].mean() - 0.5


def test_mean_field_predicts_nearly_as_well_as_nuts(fitted, nuts):
    params, _ = fitted
    target = truth(nuts["x_new"])
    ours = rmse(bnn.predict(params, jnp.asarray(nuts["x_new"])), target)
    oracle = rmse(nuts["mean"], target)
    constant = rmse(nuts["y"].mean(0), target)
    assert ours < oracle + 0.25 * (constant - oracle)


def test_samples_spread_around_the_mean_like_the_oracle_within_mean_field_limits(fitted, nuts):
    params, _ = fitted
    x = jnp.asarray(nuts["x_new"])
    draws = bnn.sample(params, x, 400, key=jax.random.key(1))
    assert draws.shape == (400, 40, 2)
    assert rmse(draws.mean(0), bnn.predict(params, x)) < 0.1
    # mean-field posteriors are narrower than the true one, but not collapsed
    ratio = float(jnp.mean(draws.std(0))) / float(nuts["sd"].mean())
    assert 0.2 < ratio < 1.5


def test_unequal_rows_are_refused():
    with pytest.raises(ValueError, match="x has 3 rows and y 4"):
        bnn.fit(
            bnn.BNNConfig(),
            bnn.BNNTrainParams(),
            jnp.zeros((3, 1)),
            jnp.zeros((4, 1)),
            key=jax.random.key(0),
        )
