"""A reversible network trained on gradients: features along which the output does not change."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from failure import revnet


@dataclasses.dataclass(frozen=True)
class LevelSetConfig:
    """Sizes and steps.

    Attributes:
        n_active: d, features that may change the output.
        depth: blocks.
        steps: of Adam, with a cosine decay.
        learning_rate: of the first step.
    """

    n_active: int = 1
    depth: int = 4
    steps: int = 600
    learning_rate: float = 1e-2

    def __post_init__(self) -> None:
        for name in ("n_active", "depth", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least 1")


class LevelSets(NamedTuple):
    """A trained map, numpy leaves; the columns of `rotation [D, D]` are the linear directions."""

    rotation: Any
    scale: Any
    network: revnet.RevNetParams


def features(found: LevelSets, x: Float[Array, "n D"]) -> Float[Array, "n D"]:
    """Features of samples; the active ones come first."""
    z = revnet.forward_stored(found.network, (x / found.scale) @ found.rotation)
    return z[:, _interleaved(x.shape[1])]


def samples(found: LevelSets, z: Float[Array, "n D"]) -> Float[Array, "n D"]:
    """The inverse of `features`."""
    back = jnp.zeros_like(z).at[:, _interleaved(z.shape[1])].set(z)
    return found.scale * revnet.inverse(found.network, back) @ found.rotation.T


def _interleaved(dim: int) -> np.ndarray:
    """Places of the features by rank: turns between the halves, so that each can bend the other."""
    half = (dim + 1) // 2
    places = np.empty(dim, int)
    places[0::2], places[1::2] = np.arange(half), half + np.arange(dim - half)
    return places


def active_share(
    network: revnet.RevNetParams,
    x: Float[Array, "n D"],
    g: Float[Array, "n D"],
    n_active: int,
) -> Float[Array, ""]:
    r"""Share of the squared gradient that the active features hold, mean over samples.

    .. math:: \frac1n \sum_i \frac{\sum_{k \le d} (\partial y_i / \partial z_k)^2}
        {\sum_k (\partial y_i / \partial z_k)^2}, \qquad
        \frac{\partial y}{\partial z} = \left(\frac{\partial x}{\partial z}\right)^{\!\top} \nabla y

    one pass backwards through the inverse. Couplings keep volumes, so no feature can win by
    shrinking all others.

    Args:
        network: reversible network of rotated samples.
        x: rotated samples.
        g: gradients in them.
        n_active: d.
    """
    z = revnet.forward_stored(network, x)
    _, pull = jax.vjp(lambda z: revnet.inverse(network, z), z)
    slopes = pull(g)[0][:, _interleaved(x.shape[1])] ** 2
    total = jnp.maximum(jnp.sum(slopes, 1), jnp.asarray(1e-30, x.dtype))
    return jnp.mean(jnp.sum(slopes[:, :n_active], 1) / total)


@lru_cache(maxsize=8)
def _program(config: LevelSetConfig) -> Any:
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    decay = optax.cosine_decay_schedule(config.learning_rate, config.steps)

    def fit(network: Any, x: Array, g: Array) -> Any:
        def step(carry: Any, t: Array) -> Any:
            params, state = carry
            share, grad = jax.value_and_grad(active_share)(params, x, g, config.n_active)
            # The time step h is a constant of the network, not a weight.
            grad = grad._replace(step=jnp.zeros_like(grad.step))
            with jax.numpy_dtype_promotion("standard"):
                update, state = optimiser.update(jax.tree.map(jnp.negative, grad), state)
                update = jax.tree.map(lambda u: -decay(t) * u, update)
            return (optax.apply_updates(params, update), state), share

        (network, _), shares = jax.lax.scan(
            step, (network, optimiser.init(network)), jnp.arange(config.steps)
        )
        return network, shares

    return jax.jit(fit)


def fit(
    x: Float[np.ndarray, "n D"],
    g: Float[np.ndarray, "..."],
    *,
    key: Key[Array, ""],
    config: LevelSetConfig = LevelSetConfig(),
) -> tuple[LevelSets, Float[np.ndarray, " t"]]:
    r"""Learn features of which the first d alone change the output, from gradients.

    First the rotation into the eigenvectors of :math:`\sum_i \nabla y_i \nabla y_i^\top`, the best
    that straight coordinates can do, then a reversible network that bends them, trained to maximise
    `active_share`.

    Args:
        x: samples in sigma.
        g: gradients there, `[n, D]`; rows that are not finite or zero are left out.
        key: random key.
        config: sizes and steps.

    Returns:
        (map, share before every step).

    Raises:
        ValueError: other shapes, more active features than parameters, no gradient.

    Source: Zhang, Zhang and Hinkle (2019), nonlinear level-set learning.
    Deviation: shares in place of cosines with every column of the Jacobian, so that one product
        with the transposed Jacobian does; no penalty on the determinant, which couplings keep at
        one; the rotation before the network; time steps of both signs.
    """
    x, g = np.asarray(x, np.float64), np.asarray(g, np.float64)
    if x.shape != g.shape or x.ndim != 2:
        raise ValueError(f"x.shape={x.shape}, g.shape={g.shape}: expected the same [n, D]")
    if config.n_active > x.shape[1]:
        raise ValueError(f"n_active={config.n_active}: expected at most {x.shape[1]}, parameters")
    good = np.all(np.isfinite(g), axis=1) & np.any(g != 0.0, axis=1)
    if not good.any():
        raise ValueError("g: expected at least one finite gradient that is not zero")
    x, g = x[good], g[good]
    g = g / np.linalg.norm(g, axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(g, full_matrices=True)
    # The strongest direction to the first place of the first half, the next to the second half.
    rotation = np.empty_like(axes.T)
    rotation[:, _interleaved(x.shape[1])] = axes.T
    scale = max(float(x.std()), 1e-300)
    with jax.enable_x64(False):
        network = revnet.init(key, x.shape[1], depth=config.depth, scale=0.1)
        # What a block adds rises with its argument everywhere; with both signs it can do both.
        signs = jnp.asarray((-1.0) ** np.arange(config.depth), jnp.float32)
        network = network._replace(step=network.step * signs)
        trained, shares = _program(config)(
            network,
            jnp.asarray(x / scale @ rotation, jnp.float32),
            jnp.asarray(g @ rotation, jnp.float32),
        )
    found = LevelSets(
        rotation, np.float64(scale), jax.tree.map(lambda a: np.asarray(a, np.float64), trained)
    )
    return found, np.asarray(shares)
