"""Deep lattice networks: shape of the function, vmapped networks, training, pictures."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from fusion.lattice import (
    CategoricalConfig,
    DeepLatticeConfig,
    LatticeConfig,
    PWLConfig,
    categorical,
    deep_lattice,
    lattice_layer,
    pwl,
    with_projection,
)
from fusion.lattice.deep_lattice import DeepLatticeParams
from fusion.lattice.plots import plot_calibrator, plot_categorical, plot_lattice_slice

# K losses in, K targets out: network k has its own loss first, the others after it.
K = 4
CONFIG = DeepLatticeConfig(K, (-1,) + (0,) * (K - 1), (0.0, 4.0))
ORDER = np.stack([np.r_[k, np.delete(np.arange(K), k)] for k in range(K)])


def _targets(params: DeepLatticeParams, losses: jax.Array) -> jax.Array:
    each = jax.vmap(lambda p, x: deep_lattice.apply(CONFIG, p, x), (0, -2), -1)
    return each(params, losses[..., ORDER])


@pytest.fixture(scope="module")
def networks() -> DeepLatticeParams:
    keys = jax.random.split(jax.random.key(0), K)
    params = jax.jit(jax.vmap(lambda key: deep_lattice.init(key, CONFIG)))(keys)
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(1)
    moved = [a + jnp.asarray(0.3 * rng.normal(size=a.shape), a.dtype) for a in leaves]
    project = jax.jit(jax.vmap(lambda p: deep_lattice.project(CONFIG, p)))
    return project(jax.tree.unflatten(tree, moved))


def test_output_falls_with_its_own_loss_and_is_free_in_the_others(
    networks: DeepLatticeParams,
) -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0, 4, (30, K)).astype(np.float32)
    sweep = np.linspace(-0.5, 4.5, 41, dtype=np.float32)
    targets = jax.jit(_targets)
    slopes = []
    for k in range(K):
        losses = np.repeat(base[:, None, :], 41, axis=1)
        losses[..., k] = sweep
        slopes.append(np.diff(np.asarray(targets(networks, jnp.asarray(losses))), axis=1))
    for k in range(K):
        # The parameters are exactly ordered; interpolation rounds to a unit or two of 1.0.
        assert slopes[k][..., k].max() <= 2.5e-7
        assert slopes[k][..., k].min() < -1e-3
    others = np.stack([slopes[j][..., k] for k in range(K) for j in range(K) if j != k])
    assert others.max() > 1e-3 and others.min() < -1e-3


def test_output_stays_within_bounds(networks: DeepLatticeParams) -> None:
    losses = jax.random.uniform(jax.random.key(2), (500, K), minval=-10.0, maxval=20.0)
    found = np.asarray(jax.jit(_targets)(networks, losses))
    assert 0.0 <= found.min() < found.max() <= 1.0


def test_vmapped_networks_equal_a_loop(networks: DeepLatticeParams) -> None:
    losses = jax.random.uniform(jax.random.key(3), (6, K), maxval=4.0)
    together = jax.jit(_targets)(networks, losses)
    apply = jax.jit(lambda p, x: deep_lattice.apply(CONFIG, p, x))
    for k in range(K):
        one = jax.tree.map(lambda a, k=k: a[k], networks)
        alone = apply(one, losses[:, ORDER[k]])
        np.testing.assert_allclose(together[:, k], alone, atol=1e-6)
    checks = jax.jit(jax.vmap(lambda p: deep_lattice.check(CONFIG, p)))(networks)
    np.testing.assert_array_equal(checks, np.zeros(K))


def test_any_batch_shape_gives_the_same_numbers(networks: DeepLatticeParams) -> None:
    one = jax.tree.map(lambda a: a[0], networks)
    x = jax.random.uniform(jax.random.key(4), (2, 3, K), maxval=4.0)
    apply = jax.jit(deep_lattice.apply, static_argnums=0)
    full = apply(CONFIG, one, x)
    assert full.shape == (2, 3)
    np.testing.assert_allclose(full[1, 2], apply(CONFIG, one, x[1, 2]), atol=1e-6)


@pytest.mark.parametrize(
    ("monotonicity", "expected"),
    [((0, 0, 0), (0, 0, 0)), ((-1, 1, 1), (1, 1, 1)), ((1, 0, 0), (1, 1, 0))],
)
def test_which_lattice_axes_are_monotone(
    monotonicity: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    config = DeepLatticeConfig(3, monotonicity, embedding_dim=3)
    assert config.axis_signs == expected
    for row, sign in zip(config.embedding.links, expected, strict=True):
        assert row.all() if sign else np.array_equal(row, np.array(monotonicity) == 0)


@pytest.mark.relaxed  # optax promotes dtypes
def test_networks_learn_softmax_targets_and_stay_monotone() -> None:
    """Mean squared error of a constant is 0.036 here; the shape is learned in 400 steps."""
    keys = jax.random.split(jax.random.key(0), K)
    params = jax.jit(jax.vmap(lambda key: deep_lattice.init(key, CONFIG)))(keys)
    project = jax.vmap(lambda p: deep_lattice.project(CONFIG, p))
    optimizer = with_projection(optax.adam(0.02), project)

    def loss_fn(params: DeepLatticeParams, losses: jax.Array) -> jax.Array:
        return jnp.mean(jnp.square(_targets(params, losses) - jax.nn.softmax(-losses, axis=-1)))

    def step(carry: tuple, key: jax.Array) -> tuple:
        params, state = carry
        losses = jax.random.uniform(key, (32, K), maxval=4.0)
        loss, grads = jax.value_and_grad(loss_fn)(params, losses)
        updates, state = optimizer.update(grads, state, params)
        params = optax.apply_updates(params, updates)
        worst = jnp.max(jax.vmap(lambda p: deep_lattice.check(CONFIG, p))(params))
        return (params, state), (loss, worst)

    @jax.jit
    def train(params: DeepLatticeParams) -> tuple:
        keys = jax.random.split(jax.random.key(1), 400)
        return jax.lax.scan(step, (params, optimizer.init(params)), keys)[1]

    losses, worst = train(params)
    assert float(jnp.mean(losses[-20:])) < 0.002
    assert float(jnp.max(worst)) == 0.0


def test_pictures_show_the_parameters() -> None:
    import matplotlib.pyplot as plt

    config = PWLConfig(2, 4, missing_value=-1.0)
    calibrators = pwl.init(jax.random.key(0), config)
    figure = plot_calibrator(config, calibrators, 1, name="speed")
    (ax,) = figure.axes
    np.testing.assert_allclose(ax.lines[0].get_xdata(), np.linspace(0, 1, 4), atol=1e-6)
    assert ax.get_xlabel() == "speed"
    categories = CategoricalConfig(3, missing_value=9)
    side = plt.figure().subplots(1, 2)
    figure = plot_categorical(
        categories, categorical.init(jax.random.key(0), categories), ax=side[1]
    )
    assert figure is side[1].figure and len(side[1].patches) == 4 and not side[0].patches
    lattice = LatticeConfig((2, 3, 2))
    params = lattice_layer.init(jax.random.key(0), lattice)
    figure = plot_lattice_slice(lattice, params, (1, 2), (1.0, 0.0, 0.0), resolution=5)
    assert figure.axes[0].get_xlim() == (0.0, 2.0)
    with pytest.raises(ValueError, match="two different inputs"):
        plot_lattice_slice(lattice, params, (1, 1))
    with pytest.raises(ValueError, match="index=2: expected"):
        plot_calibrator(config, calibrators, 2)
    plt.close("all")
