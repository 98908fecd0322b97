"""Penalties on calibrators and lattices, to add to a training loss."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.lattice.checks import refusal
from fusion.lattice.lattice_config import LatticeParams
from fusion.lattice.pwl import PWLParams


def _penalty(differences: Array, l1: float, l2: float) -> Array:
    return l1 * jnp.sum(jnp.abs(differences)) + l2 * jnp.sum(jnp.square(differences))


def pwl_laplacian(params: PWLParams, *, l1: float = 0.0, l2: float = 0.0) -> Float[Array, ""]:
    r"""Flat calibrators: differences of neighbouring outputs.

    .. math:: \sum_i l_1 |y_{i+1} - y_i| + l_2 (y_{i+1} - y_i)^2
    """
    return _penalty(jnp.diff(params.outputs, axis=-1), l1, l2)


def pwl_hessian(params: PWLParams, *, l1: float = 0.0, l2: float = 0.0) -> Float[Array, ""]:
    r"""Straight calibrators: second differences of the outputs.

    .. math:: \sum_i l_1 |y_{i+2} - 2 y_{i+1} + y_i| + l_2 (y_{i+2} - 2 y_{i+1} + y_i)^2
    """
    return _penalty(jnp.diff(params.outputs, n=2, axis=-1), l1, l2)


def pwl_wrinkle(params: PWLParams, *, l1: float = 0.0, l2: float = 0.0) -> Float[Array, ""]:
    r"""Calibrators of steady curvature: third differences of the outputs.

    .. math:: \sum_i l_1 |\Delta^3 y_i| + l_2 (\Delta^3 y_i)^2,
        \qquad \Delta^3 y_i = y_{i+3} - 3 y_{i+2} + 3 y_{i+1} - y_i
    """
    return _penalty(jnp.diff(params.outputs, n=3, axis=-1), l1, l2)


def lattice_laplacian(
    params: LatticeParams,
    *,
    l1: float | tuple[float, ...] = 0.0,
    l2: float | tuple[float, ...] = 0.0,
) -> Float[Array, ""]:
    r"""Flat lattices: differences of neighbouring vertices along every input.

    .. math:: \sum_d \sum_v l_{1,d} |\theta_{v+e_d} - \theta_v|
        + l_{2,d} (\theta_{v+e_d} - \theta_v)^2

    Args:
        params: of one lattice.
        l1: strength, or one for each input.
        l2: strength, or one for each input.

    Returns:
        The penalty.
    """
    v = params.vertices
    first = l1 if isinstance(l1, tuple) else (l1,) * v.ndim
    second = l2 if isinstance(l2, tuple) else (l2,) * v.ndim
    if len(first) != v.ndim or len(second) != v.ndim:
        raise refusal(
            "(l1, l2)", (l1, l2), f"a float or {v.ndim} of them each", "give one for each input"
        )
    total = jnp.zeros((), v.dtype)
    for axis, (a, b) in enumerate(zip(first, second, strict=True)):
        total = total + _penalty(jnp.diff(v, axis=axis), a, b)
    return total


def lattice_torsion(params: LatticeParams, *, l1: float = 0.0, l2: float = 0.0) -> Float[Array, ""]:
    r"""Lattices without interaction: twist of every 2 x 2 cell of two inputs.

    .. math:: \sum_{d < e} \sum_v l_1 |t| + l_2 t^2, \qquad
        t = \theta_{v+e_d+e_e} - \theta_{v+e_d} - \theta_{v+e_e} + \theta_v

    Args:
        params: of one lattice.
        l1: strength of the absolute twist.
        l2: strength of the squared twist.

    Returns:
        The penalty; 0 for a sum of functions of one input each.
    """
    v = params.vertices
    total = jnp.zeros((), v.dtype)
    for a, b in itertools.combinations(range(v.ndim), 2):
        total = total + _penalty(jnp.diff(jnp.diff(v, axis=a), axis=b), l1, l2)
    return total
