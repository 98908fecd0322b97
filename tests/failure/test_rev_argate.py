import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import feature_ranking, rev_argate
from failure.bnn import BNNConfig
from failure.models.acquisition import AcquisitionConfig
from failure.search import bayesopt, runs, spaces
from failure.search.task import Task
from fusion.losses import LossParams

DIM = 6
TASK = Task("box", 3.0, DIM)
CONFIG = rev_argate.RevArgateConfig(
    depth=2, gate_width=8, steps=250, restoration=BNNConfig(hidden=8, steps=50)
)

TRAIN = rev_argate.RevArgateTrainParams()


def specification(x):
    """Two of six parameters matter."""
    x = np.asarray(x)
    return (x[:, 1] + 0.3 * x[:, 4] ** 2)[:, None], np.zeros(len(x), int)


@pytest.fixture(scope="module")
def trained():
    rng = np.random.default_rng(0)
    x = rng.uniform(-3, 3, (120, DIM))
    y = specification(x)[0][:, 0]
    scaled = jnp.asarray(x / np.sqrt(3.0), jnp.float32)
    target = jnp.asarray((y - y.mean()) / y.std(), jnp.float32)
    fit = jax.jit(rev_argate.fit, static_argnums=0)
    params, losses = fit(CONFIG, TRAIN, scaled, target, jnp.ones(120), key=jax.random.key(0))
    return params, losses, scaled, target


def test_training_explains_the_target(trained):
    params, losses, x, y = trained
    assert losses[-1] < 0.3 * losses[0]
    error = rev_argate.predict(CONFIG, params, x) - y
    assert float(jnp.mean(error**2)) < 0.35


def test_a_sweep_over_rates_and_loss_weights_compiles_once():
    import chex

    chex.clear_trace_counter()
    small = dataclasses.replace(CONFIG, steps=2)
    x, y = jnp.ones((8, DIM)), jnp.arange(8.0)

    def fit(train):
        return rev_argate.fit(small, train, x, y, jnp.ones(8), key=jax.random.key(0))[1][-1]

    traced = jax.jit(chex.assert_max_traces(fit, n=1))
    changed = (
        TRAIN._replace(learning_rate=1e-3),
        TRAIN._replace(learning_rate=1e-2),
        TRAIN._replace(loss=TRAIN.loss._replace(alpha=5.0)),
    )
    losses = {float(traced(jax.tree.map(jnp.asarray, train))) for train in changed}
    assert len(losses) == 3


def test_weights_sum_to_one_and_rank_the_features(trained):
    params, _, x, _ = trained
    weights = rev_argate.fusion_weights(CONFIG, params, x)
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-5)
    order, n_active = feature_ranking.active_features(weights, 0.8)
    mean = np.asarray(weights).mean(0)
    assert np.all(np.diff(mean[order]) <= 0)
    assert mean[order[:n_active]].sum() >= 0.8 > mean[order[: n_active - 1]].sum()


def test_loss_is_equation_4_6(trained):
    params, _, x, y = trained
    mask = jnp.ones(120)
    parts = {}
    for name in ("alpha", "beta", "anchor"):
        none = LossParams(alpha=0.0, beta=0.0, tau=TRAIN.loss.tau, anchor=0.0)
        only = TRAIN._replace(loss=none._replace(**{name: 1.0}))
        total, main = rev_argate.loss(CONFIG, only, params, x, y, mask)
        parts[name] = float(total - main)
        assert parts[name] > 0
    train = TRAIN._replace(loss=LossParams(alpha=0.5, beta=2.0, tau=TRAIN.loss.tau, anchor=3.0))
    total, main = rev_argate.loss(CONFIG, train, params, x, y, mask)
    expected = float(main) + 0.5 * parts["alpha"] + 2.0 * parts["beta"] + 3.0 * parts["anchor"]
    np.testing.assert_allclose(total, expected, rtol=1e-4)
    # masked rows do not count
    doubled, _ = rev_argate.loss(
        CONFIG, train, params, jnp.concatenate([x, x]), jnp.concatenate([y, 99 * y]),
        jnp.concatenate([mask, 0 * mask]),
    )  # fmt: skip
    np.testing.assert_allclose(doubled, total, rtol=1e-4)


@pytest.mark.slow
def test_search_trains_on_counted_simulations_and_resumes(tmp_path):
    search = bayesopt.SearchConfig(
        TASK, "rev_argate_bnn", seeds=(0, 1), n_init=10, n_total=16, embedding_dim=3,
        retrain_every=3, acquisition=AcquisitionConfig(n_raw=32, n_restarts=2, max_evals=20),
        rev_argate=dataclasses.replace(CONFIG, steps=30),
    )  # fmt: skip
    counted = []

    def simulate(x):
        if sum(counted) >= 2 * 14 and not tmp_path.joinpath("free").exists():
            raise KeyboardInterrupt
        counted.append(len(x))
        return specification(x)

    with pytest.raises(KeyboardInterrupt):
        runs.run(search, simulate, folder=tmp_path)
    tmp_path.joinpath("free").touch()
    end = runs.run(search, simulate, folder=tmp_path)
    assert sum(counted) == 2 * 16 and end.y.shape == (2, 16)
    assert end.space_at == 13 and end.u.shape == (2, 16, 3)
    assert isinstance(end.space, spaces.ReversedFeatures)
    assert end.space.restoration is not None and end.space.shift.dtype == np.float64
    whole = runs.run(search, specification)
    np.testing.assert_allclose(whole.x, end.x, rtol=1e-9, atol=1e-9)


def test_bad_configuration():
    with pytest.raises(ValueError, match="depth=0"):
        rev_argate.RevArgateConfig(depth=0)
    with pytest.raises(ValueError, match="tau"):
        LossParams(tau=0.0)
    for name, value in (("weight_decay", -1.0), ("learning_rate", -1e-3)):
        with pytest.raises(ValueError, match=f"{name}={value}"):
            bayesopt.SearchConfig(
                TASK, "rev_argate_bnn", rev_argate_training=TRAIN._replace(**{name: value})
            )
