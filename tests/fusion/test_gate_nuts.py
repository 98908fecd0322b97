"""The gate's posterior on a small problem: variation and Laplace beside NUTS, which samples it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from fusion.config import HyperParams, ModelConfig
from fusion.encoders import EncoderConfig
from fusion.losses import LossConfig
from fusion.models import export, init, predict
from fusion.posteriors import fit_laplace, laplace_predictive
from fusion.train import batch_loss
from fusion.uncertainty import sample_predictive

pytestmark = [pytest.mark.relaxed, pytest.mark.slow]

PLAIN = LossConfig(
    auxiliary=False,
    loss_weighting=False,
    regularization=False,
    learned_targets=False,
    label_smoothing=0.0,
)
SIZES: dict[str, Any] = {
    "n_sensors": 2,
    "n_times": 1,
    "n_classes": 2,
    "encoder": EncoderConfig(features=3, frequencies=1),
    "gate_width": 3,
    "head_widths": (4,),
    "dropout": 0.0,
    "loss": PLAIN,
}
POINT = ModelConfig("netgated", **SIZES)
CLOUD = ModelConfig("netgated", gate_kind="variational", **SIZES)
N = 60


@pytest.fixture(scope="module")
def problem() -> tuple[Any, jax.Array, jax.Array, jax.Array]:
    """A fixed network but for the gate's last layer, rows to learn from, and rows to predict."""
    rng = np.random.default_rng(1)
    main = jax.tree.map(
        lambda p: jnp.asarray(p + 0.8 * rng.normal(size=p.shape), jnp.float32),
        export(init(jax.random.key(0), POINT)),
    )
    x, new = (jnp.asarray(rng.uniform(-1, 1, (n, 2, 1)), jnp.float32) for n in (N, 40))
    truth = jax.nn.softmax(predict(POINT, main, x).logits)[:, 1]
    y = jnp.asarray(rng.random(N) < np.asarray(truth)).astype(jnp.int32)
    return main, x, y, new


def with_split(main: Any, split: Any) -> Any:
    return main | {"gate": main["gate"] | {"split": split}}


def test_variation_and_laplace_predict_as_nuts_does(problem: Any) -> None:
    infer = pytest.importorskip("numpyro.infer", reason="install the extra `nuts`")
    main, x, y, new = problem
    start = main["gate"]["split"]

    def energy(split: Any) -> jax.Array:
        logits = predict(POINT, with_split(main, split), x).logits
        fit = optax.softmax_cross_entropy_with_integer_labels(logits, y).sum()
        return fit + 0.5 * sum(jnp.sum(p**2) for p in jax.tree.leaves(split))

    chain = infer.MCMC(
        infer.NUTS(potential_fn=energy), num_warmup=500, num_samples=1500, progress_bar=False
    )
    chain.run(jax.random.key(0), init_params=start)
    samples = chain.get_samples()
    out = jax.vmap(lambda split: predict(POINT, with_split(main, split), new))(samples)
    wanted = np.asarray(jax.nn.softmax(out.logits)).mean(0)
    weights, spread = np.asarray(out.weights).mean(0), np.asarray(out.weights).std(0)

    # The variational posterior, by the training loss of the package on this layer alone.
    spreads = {f"{name}_spread": jnp.full(p.shape, -1.0) for name, p in start.items()}
    params, adam = start | spreads, optax.adam(2e-2)

    def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
        split, state = carry
        given = {"main": with_split(main, split)}
        none = jnp.zeros(x.shape[:2], bool)

        def loss(split: Any) -> jax.Array:
            held = given | {"main": with_split(main, split)}
            return batch_loss(CLOUD, HyperParams(), held, x, y, none, key=key)[0]

        updates, state = adam.update(jax.grad(loss)(split), state)
        return (optax.apply_updates(split, updates), state), None

    keys = jax.random.split(jax.random.key(1), 3000)
    (fitted, _), _ = jax.jit(lambda c: jax.lax.scan(step, c, keys))((params, adam.init(params)))
    found = sample_predictive(
        CLOUD, with_split(main, fitted), new, key=jax.random.key(2), n_draws=2000
    )
    np.testing.assert_allclose(found.probabilities, wanted, atol=0.04)
    np.testing.assert_allclose(found.weights, weights, atol=0.06)
    width = np.asarray(found.weight_high - found.weight_low) / 3.29
    # Independent parameters cannot trade with each other: right in size, not to the digit.
    assert 0.6 < float(np.median(width / spread)) < 1.6

    # Laplace stands at the maximum of the same posterior.
    def climb(carry: Any, _: Any) -> tuple[Any, None]:
        split, state = carry
        updates, state = adam.update(jax.grad(energy)(split), state)
        return (optax.apply_updates(split, updates), state), None

    (mode, _), _ = jax.jit(lambda c: jax.lax.scan(climb, c, None, 2000))((start, adam.init(start)))
    at_mode = with_split(main, mode)
    laplace = fit_laplace(POINT, at_mode, x)
    around = laplace_predictive(POINT, at_mode, laplace, new, key=jax.random.key(3), n_draws=2000)
    np.testing.assert_allclose(around.probabilities, wanted, atol=0.06)
    width = np.asarray(around.weight_high - around.weight_low) / 3.29
    assert 0.5 < float(np.median(width / spread)) < 1.2
    # What a distribution is for: expected weights nearer to the posterior's than the mode's are.
    point = np.asarray(predict(POINT, at_mode, new).weights)
    assert np.abs(found.weights - weights).mean() < np.abs(point - weights).mean()
