"""The reversible trunk: squeezes and coupled convolutions, for series and for images alike.

Arrays are `[branch, batch, *axes, channel]` with one axis for series and two for images; the
branches (sensors) have parameters of their own and are computed as one batched matrix product.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from fusion.reversible.config import ReversibleConfig
from fusion.reversible.coupling import Coupling, Halves, couple, couple_stored, uncouple

Params = dict[str, Any]


def squeeze(x: Float[Array, "k b *axes c"], factor: int) -> Float[Array, "k b *less d"]:
    r"""Make channels of `factor` neighbours along each axis: a permutation, without parameters.

    .. math:: y_{i,\, j c} = x_{i s + j,\, c}, \qquad j = 0 \ldots s - 1

    Raises:
        ValueError: an axis that is no multiple of the factor.

    Source: Jacobsen et al. (2018), i-RevNet, for images.

    Example:
        >>> squeeze(jnp.arange(6.0).reshape(1, 1, 6, 1), 3)[0, 0].tolist()
        [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    """
    k, b, *axes, c = x.shape
    if any(n % factor for n in axes):
        raise ValueError(
            f"x.shape={tuple(x.shape)}: expected axes of multiples of {factor}; change squeezes or "
            "cut the windows"
        )
    d = len(axes)
    split = itertools.chain.from_iterable((n // factor, factor) for n in axes)
    y = x.reshape(k, b, *split, c)
    outer, inner = (tuple(2 + 2 * i + j for i in range(d)) for j in (0, 1))
    y = jnp.transpose(y, (0, 1, *outer, *inner, 2 + 2 * d))
    return y.reshape(k, b, *(n // factor for n in axes), factor**d * c)


def unsqueeze(y: Float[Array, "k b *less d"], factor: int) -> Float[Array, "k b *axes c"]:
    """The inverse of `squeeze`."""
    k, b, *axes, channels = y.shape
    d = len(axes)
    x = y.reshape(k, b, *axes, *(factor,) * d, channels // factor**d)
    order = itertools.chain.from_iterable((2 + i, 2 + d + i) for i in range(d))
    x = jnp.transpose(x, (0, 1, *order, 2 + 2 * d))
    return x.reshape(k, b, *(n * factor for n in axes), channels // factor**d)


def neighbours(x: Float[Array, "k b *axes c"], taps: int) -> Float[Array, "k b *axes j"]:
    """What a convolution sees at each place: `taps` neighbours along each axis, zeros outside."""
    axes = x.shape[2:-1]
    before = (taps - 1) // 2
    pads = [(0, 0), (0, 0), *((before, taps - 1 - before) for _ in axes), (0, 0)]
    padded = jnp.pad(x, pads)
    seen = []
    for offset in itertools.product(range(taps), repeat=len(axes)):
        place = tuple(slice(o, o + n) for o, n in zip(offset, axes, strict=True))
        seen.append(padded[(slice(None), slice(None), *place)])
    return jnp.concatenate(seen, axis=-1)


def _drive(half: str, taps: int, block: Params, other: Array) -> Array:
    r"""Two convolutions: :math:`W_2\, \text{relu}(W_1 * x + b)`."""
    seen = neighbours(other, taps)
    flat = seen.reshape(seen.shape[0], -1, seen.shape[-1])
    hidden = flat @ block[f"{half}_in"] + block[f"{half}_bias"][:, None, :]
    return (jax.nn.relu(hidden) @ block[f"{half}_out"]).reshape(other.shape)


@functools.lru_cache
def _coupling(taps: int) -> Coupling:
    return Coupling(functools.partial(_drive, "u", taps), functools.partial(_drive, "v", taps))


def stage_shapes(config: ReversibleConfig, k: int, stage: int, axes: int = 1) -> dict[str, Any]:
    """Shapes of a stage's parameters, the depth first."""
    half = config.stage_channels(axes)[stage] // 2
    depth, hidden = config.depths[stage], config.hidden[stage]
    shapes: dict[str, Any] = {}
    for name in ("u", "v"):
        shapes[f"{name}_in"] = (depth, k, config.taps[stage] ** axes * half, hidden)
        shapes[f"{name}_bias"] = (depth, k, hidden)
        shapes[f"{name}_out"] = (depth, k, hidden, half)
    return shapes


def draw_parameter(
    config: ReversibleConfig, stage: int, name: str, shape: tuple[int, ...], *, key: Key[Array, ""]
) -> Array:
    """First values: He's in, zero biases, and outputs of which the whole depth adds `start`."""
    if name.endswith("bias"):
        return jnp.zeros(shape)
    scale = math.sqrt(2.0 / shape[-2])
    if name.endswith("out"):
        scale *= config.start / math.sqrt(config.depths[stage])
    return scale * jax.random.normal(key, shape)


def init(key: Key[Array, ""], config: ReversibleConfig, k: int, *, axes: int = 1) -> Params:
    """Draw the parameters of K trunks, flat: `stage0_u_in` and so on.

    Example:
        >>> params = init(jax.random.key(0), ReversibleConfig(), k=3)
        >>> params["stage1_v_out"].shape  # depth, sensor, hidden, half of the channels
        (2, 3, 32, 16)
    """
    params = {}
    for stage in range(len(config.squeezes)):
        for name, shape in stage_shapes(config, k, stage, axes).items():
            key, own = jax.random.split(key)
            params[f"stage{stage}_{name}"] = draw_parameter(config, stage, name, shape, key=own)
    return params


def _stage(params: Params, stage: int) -> Params:
    prefix = f"stage{stage}_"
    return {n.removeprefix(prefix): v for n, v in params.items() if n.startswith(prefix)}


def _means(x: Array) -> Array:
    """Means over the axes, once for each branch, example and channel."""
    return jnp.mean(x, axis=tuple(range(2, x.ndim - 1)), keepdims=True)


def lift(config: ReversibleConfig, x: Float[Array, "k b *axes c"]) -> Halves:
    """First squeeze and zeros up to the channels of the first stage, cut into halves.

    Raises:
        ValueError: more samples than channels.
    """
    level = _means(x)
    y = squeeze(config.gain * (x - level if config.centred else x), config.squeezes[0])
    parts = [y]
    if config.centred:
        parts.append(jnp.broadcast_to(level, (*y.shape[:-1], x.shape[-1])))
    missing = config.channels - sum(part.shape[-1] for part in parts)
    if missing < 0:
        raise ValueError(
            f"channels={config.channels}: expected at least {config.channels - missing}, the "
            f"samples that squeezes[0]={config.squeezes[0]} puts side by side (and their mean, if "
            "centred); raise it or squeeze less"
        )
    parts.append(jnp.zeros((*y.shape[:-1], missing), y.dtype))
    y, half = jnp.concatenate(parts, axis=-1), config.channels // 2
    return y[..., :half], y[..., half:]


def _drop(config: ReversibleConfig, y: Array, channels: int) -> Array:
    """The inverse of `lift`, on joined halves."""
    first = config.squeezes[0]
    size = channels * first ** (y.ndim - 3)
    x = unsqueeze(y[..., :size], first) / config.gain
    return x + _means(y[..., size : size + channels]) if config.centred else x


def forward(
    config: ReversibleConfig, params: Params, x: Float[Array, "k b *axes c"]
) -> Float[Array, "k b *less d"]:
    r"""The trunk: windows in, as many numbers or more out, and none of them lost.

    .. math::
        z = (C_L \circ S_L \circ \ldots \circ C_1 \circ S_1)(g x), \qquad
        C: \; u' = u + F(v), \; v' = v + G(u')

    with squeezes S, couplings C and drives :math:`F(v) = W_2\, \text{relu}(W_1 * v + b)`.

    Args:
        config: stages.
        params: of K trunks, as `init` draws them.
        x: windows, `[branch, batch, time, channel]` or `[branch, batch, height, width, channel]`.

    Returns:
        The output of the last stage; `inverse` gives the windows back.

    Source: Shim (2020), chapter 5, proposes reversible convolutional layers for ARGate; Jacobsen
    et al. (2018) for the squeeze and the zeros that widen the first stage.

    Example:
        >>> config = ReversibleConfig((2,), channels=4, depths=(3,), hidden=(5,), taps=(3,))
        >>> params, x = init(jax.random.key(0), config, 1), jnp.ones((1, 2, 8, 1))
        >>> z = forward(config, params, x)
        >>> z.shape, bool(jnp.allclose(inverse(config, params, z), x, atol=1e-5))
        ((1, 2, 4, 4), True)
    """
    run = couple if config.recompute else couple_stored
    u, v = lift(config, x)
    for stage, factor in enumerate(config.squeezes):
        if stage:
            u, v = squeeze(u, factor), squeeze(v, factor)
        u, v = run(_coupling(config.taps[stage]), _stage(params, stage), u, v)
    return jnp.concatenate([u, v], axis=-1)


def inverse(
    config: ReversibleConfig,
    params: Params,
    z: Float[Array, "k b *less d"],
    channels: int = 1,
) -> Float[Array, "k b *axes c"]:
    """Windows of the trunk's output; what the first zeros have become is left out.

    Args:
        config, params: of `forward`.
        z: output of `forward`, or what was put in its place.
        channels: of the windows.
    """
    half = z.shape[-1] // 2
    u, v = z[..., :half], z[..., half:]
    for stage in reversed(range(len(config.squeezes))):
        u, v = uncouple(_coupling(config.taps[stage]), _stage(params, stage), u, v)
        if stage:
            u, v = (unsqueeze(part, config.squeezes[stage]) for part in (u, v))
    y = jnp.concatenate([u, v], axis=-1)
    return _drop(config, y, channels)
