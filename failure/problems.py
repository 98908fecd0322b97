"""Problems whose failure probability is known exactly: what every method is measured on.

Parameters are independent standard normal. Each problem is a pure function of jax arrays, a
threshold, and the probability in closed form or by one quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from failure.exact_tails import beta_of, orthonormal, quadratic_tail, tail, threshold_of
from failure.performances import Performance


class Problem(NamedTuple):
    """A performance function with its exact answer.

    Attributes:
        name: key of `PROBLEMS`.
        performance: `x [n, D] -> y [n]`, traceable.
        threshold: failure is `y > threshold`.
        dim: D.
        probability: exact.
        points: `[k, D]`, the nearest failing point of each region; one of them where they form a
            continuum.
        smooth: whether gradients mean anything.
    """

    name: str
    performance: Performance
    threshold: float
    dim: int
    probability: float
    points: Float[np.ndarray, "k D"]
    smooth: bool = True


def linear(p: float, dim: int) -> Problem:
    r"""One half space, :math:`y = a \cdot x`: :math:`P = \Phi(-T)`."""
    axis, reach = orthonormal(dim, 1)[0], beta_of(p)

    def performance(x: Any) -> Any:
        return x @ jnp.asarray(axis, x.dtype)

    return Problem("linear", performance, reach, dim, p, reach * axis[None])


def window(p: float, dim: int) -> Problem:
    r"""A two-sided window, :math:`y = |a \cdot x|`: :math:`P = 2 \Phi(-T)`."""
    axis, reach = orthonormal(dim, 1)[0], beta_of(0.5 * p)

    def performance(x: Any) -> Any:
        return jnp.abs(x @ jnp.asarray(axis, x.dtype) + 1e-3) - 1e-3

    # The small offset gives nominal a slope; it shifts one side out and one in.
    exact = float(tail(reach) + tail(reach + 2e-3))
    points = np.stack([reach * axis, -(reach + 2e-3) * axis])
    return Problem("window", performance, reach, dim, exact, points)


def opposite_mechanisms(p: float, dim: int) -> Problem:
    r"""Worst of three specifications, two of them with opposite mechanisms.

    .. math:: y = \max(a x - T_1, -a x - T_2, b x - T_3), \qquad
        P = 1 - (1 - \Phi(-T_1) - \Phi(-T_2)) (1 - \Phi(-T_3))
    """
    a, b = orthonormal(dim, 2)
    limits = [beta_of(0.5 * p), beta_of(0.3 * p), beta_of(0.2 * p)]

    def performance(x: Any) -> Any:
        u, v = x @ jnp.asarray(a, x.dtype), x @ jnp.asarray(b, x.dtype)
        return jnp.maximum(jnp.maximum(u - limits[0], -u - limits[1]), v - limits[2])

    one, two, three = (float(tail(t)) for t in limits)
    exact = one + two + three - (one + two) * three
    points = np.stack([limits[0] * a, -limits[1] * a, limits[2] * b])
    return Problem("opposite_mechanisms", performance, 0.0, dim, exact, points)


def many_regions(p: float, dim: int) -> Problem:
    r"""Eight regions along orthogonal axes: :math:`P = 1 - (1 - \Phi(-T))^8`."""
    axes, reach = orthonormal(dim, 8), beta_of(p / 8.0)

    def performance(x: Any) -> Any:
        return jnp.max(x @ jnp.asarray(axes.T, x.dtype), axis=1)

    exact = float(-math.expm1(8.0 * math.log1p(-tail(reach))))
    return Problem("many_regions", performance, reach, dim, exact, reach * axes)


def hidden_region(p: float, dim: int) -> Problem:
    r"""Two regions of equal probability; the second shows only close to failure.

    .. math:: y = \max(a x - T, 20 (b x - T)), \qquad P = 1 - (1 - \Phi(-T))^2
    """
    a, b = orthonormal(dim, 2)
    reach = beta_of(0.5 * p)

    def performance(x: Any) -> Any:
        u, v = x @ jnp.asarray(a, x.dtype), x @ jnp.asarray(b, x.dtype)
        return jnp.maximum(u - reach, 20.0 * (v - reach))

    one = float(tail(reach))
    return Problem(
        "hidden_region", performance, 0.0, dim, 2.0 * one - one * one, reach * np.stack([a, b])
    )


def bent(p: float, dim: int) -> Problem:
    r"""A boundary that bends towards nominal in ten directions.

    .. math:: y = a x + c \sum_{k=1}^{10} (b_k x)^2, \qquad
        P = \int \Phi(-(T - c s)) \chi^2_{10}(s)\, ds

    with :math:`c = 0.02`.
    """
    axes, bend = orthonormal(dim, 11), 0.02
    reach = threshold_of(lambda t: quadratic_tail(t, bend, 10), p)

    def performance(x: Any) -> Any:
        z = x @ jnp.asarray(axes.T, x.dtype)
        return z[:, 0] + bend * jnp.sum(z[:, 1:] ** 2, 1)

    return Problem("bent", performance, reach, dim, p, reach * axes[:1])


def curved_manifold(p: float, dim: int) -> Problem:
    r"""A valley that turns in an active plane: :math:`y = a x + c\,((b x)^2 - 1)`, c = 0.15.

    .. math:: P = \int \Phi(-(T + c - c v^2)) \phi(v)\, dv
    """
    a, b = orthonormal(dim, 2)
    bend = 0.15

    def exact(t: float) -> float:
        return quadratic_tail(t + bend, bend, 1)

    reach = threshold_of(exact, p)

    def performance(x: Any) -> Any:
        u, v = x @ jnp.asarray(a, x.dtype), x @ jnp.asarray(b, x.dtype)
        return u + bend * (v**2 - 1.0)

    # Nearest boundary point in the plane, by a fine scan of v.
    v = np.linspace(0.0, 12.0, 120_001)
    u = reach + bend - bend * v**2
    k = int(np.argmin(u**2 + v**2))
    points = np.stack([u[k] * a + s * v[k] * b for s in (1.0, -1.0)])
    points = points[:1] if v[k] == 0.0 else points
    return Problem("curved_manifold", performance, reach, dim, p, points)


def shell(p: float, dim: int) -> Problem:
    r"""Failure on a whole circle: :math:`y = |(a x, b x)|`, :math:`P = e^{-T^2 / 2}`."""
    axes, reach = orthonormal(dim, 2), math.sqrt(-2.0 * math.log(p))

    def performance(x: Any) -> Any:
        z = x @ jnp.asarray(axes.T, x.dtype)
        # The offset gives nominal a slope; it moves the circle's centre by a millisigma.
        return jnp.sqrt((z[:, 0] + 1e-3) ** 2 + z[:, 1] ** 2 + 1e-12)

    from scipy.stats import ncx2

    exact = float(ncx2.sf(reach**2, 2, 1e-6))
    return Problem("shell", performance, reach, dim, exact, (reach - 1e-3) * axes[:1])


def steps(p: float, dim: int) -> Problem:
    r"""A measure that comes in steps, :math:`y = \lfloor 2 a x \rfloor / 2` (a counter)."""
    axis, reach = orthonormal(dim, 1)[0], beta_of(p)

    def performance(x: Any) -> Any:
        # Steps end at the threshold exactly, so that the probability is that of a half space.
        return jnp.floor(2.0 * (x @ jnp.asarray(axis, x.dtype) - reach)) / 2.0

    return Problem("steps", performance, -0.25, dim, p, reach * axis[None], smooth=False)


def never_settles(p: float, dim: int) -> Problem:
    r"""A settling time that grows without bound; what never settles is declared a failure.

    .. math:: y = -\log(1 - a x / T) \;\text{for}\; a x < T, \quad \infty \to 10^6 \;\text{else}
    """
    axis, reach = orthonormal(dim, 1)[0], beta_of(p)

    def performance(x: Any) -> Any:
        share = x @ jnp.asarray(axis, x.dtype) / reach
        held = jnp.minimum(share, 1.0 - 1e-9)
        return jnp.where(share < 1.0, -jnp.log1p(-held), 1e6)

    return Problem("never_settles", performance, 25.0, dim, p, reach * axis[None], smooth=False)


PROBLEMS: dict[str, Callable[[float, int], Problem]] = {
    "linear": linear,
    "window": window,
    "opposite_mechanisms": opposite_mechanisms,
    "many_regions": many_regions,
    "hidden_region": hidden_region,
    "bent": bent,
    "curved_manifold": curved_manifold,
    "shell": shell,
    "steps": steps,
    "never_settles": never_settles,
}
"""Name -> `make(probability, dim)`."""


def make_problem(name: str, probability: float, dim: int = 60) -> Problem:
    """A problem of known probability.

    Args:
        name: a key of `PROBLEMS`.
        probability: wanted; exact to the offsets that give nominal a slope, see
            `Problem.probability`.
        dim: number of parameters, at least 12.

    Raises:
        ValueError: unknown name, a probability outside (0, 0.1], too few parameters.

    Example:
        >>> round(make_problem("linear", 1e-6).threshold, 4)
        4.7534
    """
    if name not in PROBLEMS:
        raise ValueError(f"name={name!r}: expected one of {', '.join(PROBLEMS)}")
    if not 0.0 < probability <= 0.1:
        raise ValueError(f"probability={probability}: expected a number in (0, 0.1]")
    if dim < 12:
        raise ValueError(f"dim={dim}: expected at least 12, the directions of the problems")
    return PROBLEMS[name](probability, dim)
