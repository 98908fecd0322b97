"""Spikes with a derivative: a step in the forward pass, a bell around the threshold in the other.

A tangent rule (`jax.custom_jvp`) serves forward and reverse mode alike, so that `jax.jvp`,
`jax.grad` and `jax.hessian` see the same function.
"""

from __future__ import annotations

import functools
import math
from typing import Any, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion._checks import check_choice
from fusion.spiking.config import Surrogate


def surrogate_slope(
    x: Float[Array, "*s"], surrogate: Surrogate | str = "fast_sigmoid", slope: float = 4.0
) -> Float[Array, "*s"]:
    r"""The derivative that stands in for that of the step, for :math:`k` = `slope`.

    .. math::
        \text{fast\_sigmoid:} \; \frac{1}{(1 + k|x|)^2} \qquad
        \text{arctan:} \; \frac{1}{1 + (\tfrac{\pi}{2} k x)^2} \\
        \text{triangular:} \; \max(0, 1 - k|x|) \qquad
        \text{straight\_through:} \; 1

    All are 1 at the threshold, so that one learning rate serves all of them.

    Args:
        x: potential above the threshold.
        surrogate: which of them; slope: k.

    Raises:
        ValueError: an unknown surrogate.

    Source: Zenke and Ganguli (2018), SuperSpike (fast sigmoid); Fang et al. (2021), arctan without
    its factor k / 2; Esser et al. (2016), triangular; Bengio et al. (2013), straight-through.

    Example:
        >>> surrogate_slope(jnp.array([0.0, 0.25]), "fast_sigmoid", 4.0).tolist()
        [1.0, 0.25]
    """
    check_choice("surrogate", surrogate, get_args(Surrogate))
    if surrogate == "fast_sigmoid":
        return 1.0 / (1.0 + slope * jnp.abs(x)) ** 2
    if surrogate == "arctan":
        return 1.0 / (1.0 + (0.5 * math.pi * slope * x) ** 2)
    if surrogate == "triangular":
        return jnp.maximum(0.0, 1.0 - slope * jnp.abs(x))
    return jnp.ones_like(x)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def spike(
    x: Float[Array, "*s"], surrogate: Surrogate | str = "fast_sigmoid", slope: float = 4.0
) -> Float[Array, "*s"]:
    r"""1 where the potential is above the threshold, else 0; its derivative is the surrogate's.

    .. math:: s = [x > 0], \qquad \frac{\partial s}{\partial x} := \text{surrogate\_slope}(x)

    Args:
        x: potential minus threshold.
        surrogate, slope: of `surrogate_slope`; static.

    Example:
        >>> spike(jnp.array([-0.1, 0.0, 0.1])).tolist()
        [0.0, 0.0, 1.0]
        >>> float(jax.grad(spike)(jnp.zeros(())))
        1.0
    """
    check_choice("surrogate", surrogate, get_args(Surrogate))
    return (x > 0.0).astype(jnp.result_type(x))


@spike.defjvp
def _spike_jvp(
    surrogate: str, slope: float, primals: tuple[Any], tangents: tuple[Any]
) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return spike(x, surrogate, slope), surrogate_slope(jnp.asarray(x), surrogate, slope) * dx
