"""Kronecker-factored lattice: a sum of products of curves, for more inputs than a table holds."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_range,
    require_signs,
    require_static,
    require_width,
)
from fusion.lattice.projections import isotonic
from fusion.lattice.rounding import frame, onto


class KroneckerParams(NamedTuple):
    """`kernel` `[term, input, vertex]`: outputs of the curves; `bias`: added, `[]`."""

    kernel: Float[Array, "m d v"]
    bias: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class KroneckerConfig:
    """A factored lattice. Every input runs over `[0, size - 1]`; inputs outside are clipped.

    Attributes:
        n_inputs: D; size: vertices along each input, at least 2.
        n_terms: M, products that are added; every second one is subtracted.
        monotonicity: -1, 0 or +1 for each input; `None` is all free.
        output_range: both bounds, or `(None, None)`.

    Raises:
        ValueError: sizes or constraints mean nothing, or one bound only.
        TypeError: a field is of a wrong type.

    Example:
        >>> KroneckerConfig(20, monotonicity=(1,) * 20).n_parameters
        161
    """

    n_inputs: int
    size: int = 2
    n_terms: int = 4
    monotonicity: tuple[int, ...] | None = None
    output_range: tuple[float | None, float | None] = (None, None)

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        require_static(self)
        require_count("n_inputs", self.n_inputs)
        require_count("size", self.size, 2)
        require_count("n_terms", self.n_terms)
        require_signs("monotonicity", self.monotonicity, self.n_inputs)
        require_range("output_range", self.output_range)
        if sum(side is None for side in self.output_range) == 1:
            raise refusal(
                "output_range", self.output_range, "two bounds or none", "give the other one"
            )

    @property
    def n_parameters(self) -> int:
        """Numbers of the kernel and the bias; a table has `size ** n_inputs`."""
        return self.n_terms * self.n_inputs * self.size + 1

    @property
    def bounded(self) -> bool:
        """Whether the output has bounds."""
        return self.output_range[0] is not None

    @property
    def term_signs(self) -> np.ndarray:
        """`[term]` of +1 and -1 in turn."""
        return 1 - 2 * (np.arange(self.n_terms) % 2)

    @property
    def directions(self) -> np.ndarray:
        """`[term, input]`: +1 where the curve must rise, -1 where it must fall, 0 where free."""
        signs = np.asarray(self.monotonicity or (0,) * self.n_inputs)
        found: np.ndarray = self.term_signs[:, None] * signs[None]
        return found

    @property
    def kernel_range(self) -> tuple[float | None, float | None]:
        """Bounds of the curves: factors of a monotone product must not be negative."""
        if self.bounded:
            return 0.0, 1.0
        return (0.0 if self.directions.any() else None), None


def init(key: Key[Array, ""], config: KroneckerConfig) -> KroneckerParams:
    """Straight curves near one, up or down with monotone inputs, at random with free ones.

    Returns:
        KroneckerParams; feasible.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    shape = (config.n_terms, config.n_inputs, 1)
    coin_key, size_key = jax.random.split(key)
    coin = jax.random.rademacher(coin_key, shape, dtype=jnp.float32)
    given = jnp.asarray(config.directions, jnp.float32)[:, :, None]
    sign = jnp.where(given == 0.0, coin, given)
    # Products of many factors below one vanish: their depth shrinks with the number of inputs.
    depth = jax.random.uniform(size_key, shape, jnp.float32, 0.5, 1.0) / config.n_inputs
    along = jnp.linspace(0.0, 1.0, config.size, dtype=jnp.float32)
    rising = jnp.where(sign > 0.0, along, 1.0 - along)
    return project(config, KroneckerParams(1.0 - depth * (1.0 - rising), jnp.zeros(())))


def apply(
    config: KroneckerConfig, params: KroneckerParams, x: Float[Array, "*batch d"]
) -> Float[Array, "*batch"]:
    r"""Products of curves, added up.

    .. math::
        \phi_{md}(x) = \sum_v \theta_{mdv} \max(0, 1 - |x - v|), \qquad
        f(x) = b + \sum_{m=1}^{M} \sigma_m \prod_{d=1}^{D} \phi_{md}(x_d)

    With bounds l, h the kernel lies in [0, 1] and the terms are averaged:

    .. math::
        f(x) = l + \frac{h - l}{M} \sum_m g_m, \qquad
        g_m = \begin{cases} \prod_d \phi_{md}(x_d) & \sigma_m = 1 \\
        1 - \prod_d \phi_{md}(x_d) & \sigma_m = -1 \end{cases}

    Symbols: :math:`\theta` is `params.kernel`; b is `params.bias` (not read with bounds);
    :math:`\sigma_m` is 1 and -1 in turn. It is the lattice with the table
    :math:`b + \sum_m \sigma_m \bigotimes_d \theta_{md}`, which is never made.

    Args:
        config, params: of the layer.
        x: inputs in lattice coordinates `[0, size - 1]`; clipped.

    Returns:
        The output, without the last axis of `x`.

    Raises:
        ValueError: the last axis of `x` is not the number of inputs.

    Source: Bakshi and others (2021), the layer KroneckerFactoredLattice of TensorFlow Lattice.
    Deviation: fixed signs of the terms; their sizes are in the kernel.

    Example:
        >>> config = KroneckerConfig(2, n_terms=1)
        >>> params = KroneckerParams(jnp.array([[[0.0, 1.0], [0.0, 1.0]]]), jnp.array(0.0))
        >>> float(apply(config, params, jnp.array([0.5, 0.5])))
        0.25
    """
    require_width(x, config.n_inputs, "kronecker.apply")
    places = jnp.arange(config.size, dtype=x.dtype)
    at = jnp.clip(x, 0.0, config.size - 1.0)[..., None]
    corners = jnp.maximum(1.0 - jnp.abs(at - places.reshape(*(1,) * x.ndim, -1)), 0.0)
    curves = jnp.einsum("...dv,mdv->...md", corners, params.kernel)
    signs = jnp.asarray(config.term_signs, curves.dtype)
    total = jnp.prod(curves, axis=-1) @ signs
    low, high = config.output_range
    if low is None or high is None:
        return total + params.bias
    falling = config.n_terms // 2
    return low + (high - low) / config.n_terms * (total + falling)


def project(config: KroneckerConfig, params: KroneckerParams) -> KroneckerParams:
    r"""The nearest parameters for which the layer is monotone and within its bounds.

    A product rises in an input when that input's curve rises and no other is negative; so curves of
    monotone inputs are ordered along their vertices (isotonic regression, falling in terms that are
    subtracted), and with any of these all curves are clipped at zero. Clipping after it is the
    projection onto both. The condition is sufficient, not necessary.

    Returns:
        KroneckerParams of the same types; what holds already is moved by rounding only.
    """
    place = frame(params.kernel, config.kernel_range)
    kernel = params.kernel.astype(place.step.dtype)
    if config.directions.any():
        sign = jnp.asarray(config.directions, kernel.dtype)[:, :, None]
        kernel = jnp.where(sign == 0.0, kernel, sign * isotonic(sign * kernel))
    return params._replace(kernel=onto(place, kernel).astype(params.kernel.dtype))


def check(config: KroneckerConfig, params: KroneckerParams) -> Float[Array, ""]:
    """The largest violation of an order or a bound of the kernel; 0 where all hold."""
    kernel = params.kernel
    sign = jnp.asarray(config.directions, kernel.dtype)[:, :, None]
    found = [jnp.max(-sign * jnp.diff(kernel, axis=-1))]
    low, high = config.kernel_range
    if low is not None:
        found.append(low - jnp.min(kernel))
    if high is not None:
        found.append(jnp.max(kernel) - high)
    return jnp.maximum(jnp.max(jnp.stack(found)), jnp.zeros((), kernel.dtype))
