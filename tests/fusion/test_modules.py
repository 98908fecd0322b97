"""ARGate around any encoders: trains, has the loss of the equation, keeps lattices monotone."""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.core import freeze

from fusion.lattice import check_tree, with_projection
from fusion.losses import LossConfig, LossParams, argate_loss, cross_entropy
from fusion.modules import ARGate, ARGateLoss, LatticeTargets, project_argate
from fusion.targets import TargetConfig, check_targets

pytestmark = pytest.mark.relaxed

LATTICE = TargetConfig(n_keypoints=3, n_hidden_keypoints=3, lattice_size=2)
LEARNED = LossConfig(label_smoothing=0.0, uniform_floor=1.0)


class Picture(nn.Module):
    """A convolution, as a camera would have."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return nn.Dense(6)(nn.relu(nn.Conv(3, (3, 3))(x)).mean(axis=(1, 2)))


def network(targets: nn.Module | None = None) -> ARGate:
    """Sensors of three kinds: an image, a vector, a scalar."""
    return ARGate(
        encoders=(Picture(), nn.Dense(6), nn.Sequential([nn.Dense(8), nn.relu, nn.Dense(6)])),
        head=nn.Sequential([nn.Dense(16), nn.relu, nn.Dense(2)]),
        auxiliary_heads=(nn.Dense(2), nn.Dense(2), nn.Dense(2)),
        targets=targets,
        gate_width=8,
    )


def batch(n: int = 96) -> tuple[list[jax.Array], jax.Array]:
    """Every sensor tells the class, but the vector is noise in half of the examples."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, n)
    sign = 2.0 * y - 1.0
    image = 0.3 * rng.normal(size=(n, 5, 5, 1)) + sign[:, None, None, None]
    vector = np.where(np.arange(n)[:, None] % 2, rng.normal(size=(n, 4)), sign[:, None])
    arrays = [image, vector, sign[:, None] + 0.3 * rng.normal(size=(n, 1))]
    return [jnp.asarray(a, jnp.float32) for a in arrays], jnp.asarray(y, jnp.int32)


@pytest.mark.slow
def test_training_with_any_encoders_keeps_the_lattice_monotone() -> None:
    readings, labels = batch()
    loss = ARGateLoss(network(LatticeTargets(LATTICE)), LEARNED)
    weigh = LossParams(tau=0.5, anchor=0.3)
    params = jax.jit(loss.init)(jax.random.key(0), weigh, readings, labels)["params"]
    optimizer = optax.adam(1e-2)

    @jax.jit
    def step(params, state):
        total = lambda p: loss.apply({"params": p}, weigh, readings, labels).total  # noqa: E731
        value, slopes = jax.value_and_grad(total)(params)
        updates, state = optimizer.update(slopes, state, params)
        return project_argate(LATTICE, optax.apply_updates(params, updates)), state, value

    state, values = optimizer.init(params), []
    for _ in range(60):
        params, state, value = step(params, state)
        values.append(float(value))
    assert values[-1] < 0.5 * values[0]
    lattice = params["model"]["targets"]["fusion_targets"].value
    assert float(check_targets(LATTICE, lattice)) == 0.0
    # The network alone, without its loss; the noisy sensor weighs less where it is noise.
    out = network(LatticeTargets(LATTICE)).apply({"params": params["model"]}, readings)
    assert (out.output.argmax(1) == labels).mean() > 0.97
    assert out.weights[1::2, 1].mean() < out.weights[::2, 1].mean()


@pytest.mark.parametrize("how", ["with_projection", "MultiSteps", "frozen", "unboxed"])
def test_lattice_targets_are_projected_in_any_tree(how: str) -> None:
    targets = LatticeTargets(LATTICE)
    losses = jnp.zeros((1, 3))
    # A legacy key, as many flax programs pass it.
    params = {"deep": [targets.init(jax.random.PRNGKey(0), losses)["params"]], "rest": jnp.ones(2)}
    broken = jax.tree.map(lambda a: a + jax.random.normal(jax.random.key(1), a.shape), params)
    assert float(check_tree(broken)) > 0.1
    if how == "frozen":
        moved = project_argate(LATTICE, freeze(broken))["deep"][0]["fusion_targets"].value
    elif how == "unboxed":
        moved = project_argate(LATTICE, nn.unbox(broken))["deep"][0]["fusion_targets"]
    else:
        optimizer = with_projection(optax.sgd(1.0))
        if how == "MultiSteps":
            optimizer = optax.MultiSteps(optimizer, 1)
        slopes = jax.tree.map(jnp.subtract, params, broken)
        updates, _ = optimizer.update(slopes, optimizer.init(params), params)
        moved = optax.apply_updates(params, updates)["deep"][0]["fusion_targets"].value
    assert float(check_targets(LATTICE, moved)) == 0.0


def test_the_loss_is_that_of_the_functions() -> None:
    readings, labels = batch(8)
    config = dataclasses.replace(LEARNED, learned_targets=False, uniform_floor=0.25)
    loss, weigh = ARGateLoss(network(), config), LossParams(0.5, 2.0, 0.7, 0.0)
    variables = loss.init(jax.random.key(0), weigh, readings, labels)
    terms = loss.apply(variables, weigh, readings, labels)
    out = network().apply({"params": variables["params"]["model"]}, readings)
    losses = jnp.stack([cross_entropy(y, labels) for y in out.auxiliary], axis=-1)
    same = argate_loss(config, weigh, out.output, labels, out.weights, losses)
    np.testing.assert_allclose(terms, same, rtol=1e-6)


def test_absent_sensors_have_no_influence() -> None:
    readings, _ = batch(4)
    net = network()
    variables = net.init(jax.random.key(0), readings)
    there = jnp.ones((4, 3), bool).at[:, 1].set(False)
    out = net.apply(variables, readings, there)
    other = net.apply(variables, [readings[0], 5.0 - readings[1], readings[2]], there)
    np.testing.assert_array_equal(out.output, other.output)
    np.testing.assert_allclose(out.weights[:, 1], 0.0)
    np.testing.assert_allclose(out.weights.sum(1), 1.0, rtol=1e-6)


def test_a_regression_is_trained_with_a_loss_of_its_own() -> None:
    readings, labels = batch(8)
    heads = (nn.Dense(1),) * 3
    net = ARGate((Picture(), nn.Dense(6), nn.Dense(6)), nn.Dense(1), heads)
    squared = lambda y, goal: (y[:, 0] - goal) ** 2  # noqa: E731
    loss = ARGateLoss(net, LossConfig(learned_targets=False), squared)
    goal = labels.astype(jnp.float32)
    variables = loss.init(jax.random.key(0), LossParams(), readings, goal)
    terms = loss.apply(variables, LossParams(), readings, goal)
    out = net.apply({"params": variables["params"]["model"]}, readings)
    np.testing.assert_allclose(terms.main, jnp.mean(squared(out.output, goal)), rtol=1e-6)


def test_what_does_not_belong_together_is_refused() -> None:
    readings, labels = batch(4)
    key = jax.random.key(0)
    dense = nn.Dense(3)
    with pytest.raises(ValueError, match="auxiliary_heads=1 modules: expected none or 2"):
        ARGate((dense, dense), dense, (dense,)).init(key, readings[1:])
    with pytest.raises(ValueError, match="readings=3 sensors: expected 2"):
        ARGate((dense, dense), dense).init(key, readings)
    with pytest.raises(ValueError, match="expected one shape"):
        ARGate((dense, nn.Dense(4)), dense).init(key, readings[1:])
    with pytest.raises(ValueError, match=r"config.learned_targets=True: expected a model with"):
        ARGateLoss(network(), LEARNED).init(key, LossParams(), readings, labels)
