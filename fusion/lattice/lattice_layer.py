"""The lattice: a learned table over a grid, interpolated between its vertices."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice.checks import require_key, require_width
from fusion.lattice.constraints import project_vertices, violation
from fusion.lattice.lattice_config import LatticeConfig, LatticeParams
from fusion.lattice.rounding import frame, onto


def init(key: Key[Array, ""], config: LatticeConfig) -> LatticeParams:
    """A plane across the output range, up or down with monotone inputs, at random with free ones.

    Args:
        key: PRNG key.
        config: the lattice.

    Returns:
        LatticeParams; feasible.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    low, high = config.output_range
    if low is None:
        low = 0.0 if high is None else high - 1.0
    if high is None:
        high = low + 1.0
    # On the host, but for the coins: a thousand vertices are not worth a compiled program for each
    # operation. Only constraints between inputs need a projection: every order holds in a plane.
    index = np.indices(config.sizes)
    fixed = np.zeros(config.sizes)
    free = []
    leans, turns = _joint(config)
    for axis, size in enumerate(config.sizes):
        fraction = index[axis] / (size - 1) - 0.5
        unimodal = config.unimodality[axis] if config.unimodality else 0
        unimodal = unimodal or turns[axis]
        lean = int(config.signs[axis]) or leans[axis]
        if unimodal:
            centre = config.centre(axis)
            fixed += unimodal * (
                np.abs(index[axis] - centre) / max(centre, size - 1 - centre) - 0.5
            )
        elif lean:
            fixed += lean * fraction
        else:
            free.append((axis, fraction))
    scale = (high - low) / config.rank
    plane = jnp.asarray(low + 0.5 * (high - low) + scale * fixed, jnp.float32)
    if free:
        axes, fractions = (np.stack(part) for part in zip(*free, strict=True))
        coin = jax.random.rademacher(key, (config.rank,), dtype=jnp.float32)[axes]
        plane = plane + jnp.tensordot(coin, jnp.asarray(scale * fractions, jnp.float32), 1)
    if config.relations:
        return _feasible(config, LatticeParams(plane))
    return LatticeParams(_settle(plane, config.output_range))


def _joint(config: LatticeConfig) -> tuple[np.ndarray, np.ndarray]:
    """Of free inputs: directions that joint monotonicity, and turns that joint unimodality asks."""
    leans, turns = np.zeros(config.rank, int), np.zeros(config.rank, int)
    for first, second, direction in config.joint_monotonicity:
        leans[[first, second]] += direction
    for axes, direction in config.joint_unimodality:
        turns[list(axes)] = direction
    return np.sign(leans), turns


@functools.partial(jax.jit, static_argnums=1)
def _settle(plane: Array, output_range: tuple[float | None, float | None]) -> Array:
    return onto(frame(plane, output_range), plane)


def apply(
    config: LatticeConfig, params: LatticeParams, x: Float[Array, "*batch rank"]
) -> Float[Array, "*batch"]:
    r"""The interpolated output at `x`.

    Multilinear ("hypercube") interpolation weighs every vertex :math:`v` by

    .. math:: f(x) = \sum_v \theta_v \prod_d \max(0, 1 - |x_d - v_d|)

    simplex interpolation walks from the lower corner of the cell to the upper one along the
    inputs in falling order of their fractional parts :math:`r`,

    .. math:: f(x) = \theta_{p_0} + \sum_{k=1}^{D} r_{\pi(k)} (\theta_{p_k} - \theta_{p_{k-1}}),
        \qquad p_k = p_{k-1} + e_{\pi(k)}

    Symbols: :math:`\theta` is `params.vertices`; :math:`D` is the rank; :math:`\pi` sorts
    :math:`r`. Both agree on vertices and edges, and keep monotonicity and bounds.

    Args:
        config: of the lattice.
        params: of the lattice.
        x: inputs in lattice coordinates `[0, sizes - 1]`; clipped.

    Returns:
        The output, without the last axis of `x`.

    Raises:
        ValueError: the last axis of `x` is not the number of inputs.

    Source: Gupta et al. (2016), Monotonic calibrated interpolated look-up tables, sections 2-3.

    Example:
        >>> config = LatticeConfig((2, 2))
        >>> params = LatticeParams(jnp.array([[0.0, 1.0], [2.0, 3.0]]))
        >>> float(apply(config, params, jnp.array([0.5, 0.5])))
        1.5
    """
    require_width(x, config.rank, "lattice_layer.apply")
    if config.interpolation == "simplex":
        return _simplex(config, params.vertices, x)
    return _hypercube(config, params.vertices, x)


def _hypercube(config: LatticeConfig, v: Array, x: Array) -> Array:
    """Corner weights of two halves of the axes, with the table as a matrix between them.

    The table of all corner weights of a batch would be as large as batch times lattice; the two
    halves are its square root.
    """
    sizes = config.sizes
    products = [math.prod(sizes[:axis]) for axis in range(1, config.rank + 1)]
    split = 1 + int(np.argmin([max(p, products[-1] // p) for p in products]))
    left = _corner_weights(config, x, range(split))
    right = _corner_weights(config, x, range(split, config.rank))
    table = v.reshape(left.shape[-1], right.shape[-1])
    return jnp.sum((left @ table) * right, axis=-1)


def _corner_weights(config: LatticeConfig, x: Array, axes: range) -> Array:
    """Product over some axes of the weight of each of their vertices, flattened."""
    batch, lead = x.shape[:-1], (1,) * (x.ndim - 1)
    out: Array | None = None
    for axis in axes:
        size = config.sizes[axis]
        at = jnp.clip(x[..., axis], 0.0, size - 1.0)[..., None]
        places = jnp.arange(size, dtype=x.dtype).reshape(*lead, size)
        weights = jnp.maximum(1.0 - jnp.abs(at - places), 0.0)
        pairs = weights if out is None else out[..., :, None] * weights[..., None, :]
        out = pairs.reshape(*batch, -1)
    return jnp.ones((*batch, 1), x.dtype) if out is None else out


def _simplex(config: LatticeConfig, v: Array, x: Array) -> Array:
    sizes = np.asarray(config.sizes)
    strides = np.cumprod([1, *sizes[:0:-1]])[::-1]
    lead = (1,) * (x.ndim - 1)
    top = jnp.asarray((sizes - 1).reshape(*lead, -1), x.dtype)
    at = jnp.clip(x, 0.0, top)
    corner = jnp.minimum(jnp.floor(at), top - 1.0)
    fraction = at - corner
    order = jnp.argsort(-fraction, axis=-1)
    step = jnp.asarray(strides.reshape(*lead, -1), jnp.int32)
    start = jnp.sum(corner.astype(jnp.int32) * step, axis=-1, keepdims=True)
    steps = jnp.take_along_axis(jnp.broadcast_to(step, order.shape), order, axis=-1)
    walk = jnp.concatenate([start, start + jnp.cumsum(steps, axis=-1)], axis=-1)
    values = v.reshape(-1)[walk]
    ordered = jnp.take_along_axis(fraction, order, axis=-1)
    return values[..., 0] + jnp.sum(ordered * jnp.diff(values, axis=-1), axis=-1)


def project(config: LatticeConfig, params: LatticeParams) -> LatticeParams:
    """The nearest lattice that satisfies the constraints, by Dykstra and an exact last step.

    One family of constraints is projected in closed form. Several take `config.n_iterations`
    passes, which tend to the Euclidean projection; a last step then removes what violation is
    left, so that the result is feasible after any number of passes.

    Args:
        config: of the lattice.
        params: of the lattice.

    Returns:
        LatticeParams with `check(...) == 0`, here and after an optimizer step that leads here.

    Raises:
        ValueError: the output range holds too few numbers of the type of the parameters.
    """
    return LatticeParams(project_vertices(config, config.signs, params.vertices))


def check(config: LatticeConfig, params: LatticeParams) -> Float[Array, ""]:
    """Largest violation of any constraint; 0 where all hold."""
    return violation(config, config.signs, params.vertices)


def vertices(
    config: LatticeConfig, params: LatticeParams
) -> tuple[tuple[np.ndarray, ...], Float[Array, "*sizes"]]:
    """Coordinates along each input, and the table of outputs over them."""
    return tuple(np.arange(size, dtype=np.float32) for size in config.sizes), params.vertices


# One program instead of one for each of its operations.
_feasible = functools.partial(jax.jit, static_argnums=0)(project)
