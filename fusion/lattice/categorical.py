"""Categorical calibrator: one learned output for each category, with a partial order."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_range,
    require_static,
)
from fusion.lattice.projections import (
    dykstra,
    order_closure,
    pair_projections,
    repair_order,
)
from fusion.lattice.rounding import frame, onto, working


class CategoricalParams(NamedTuple):
    """`outputs` `[n_categories]`; `missing` `[]`, or `None` where no category is missing."""

    outputs: Array
    missing: Array | None = None


@dataclasses.dataclass(frozen=True)
class CategoricalConfig:
    """A calibrator of one categorical input.

    Attributes:
        n_categories: categories `0..n_categories - 1`.
        order: pairs `(low, high)` of categories: the output of the first is at most that of the
            second. Any pairs without a circle; what follows from them holds too.
        output_range: `(low, high)`, either of which may be `None`.
        missing_value: an integer outside the categories that stands for a missing input, with a
            learned output of its own.
        n_iterations: passes of Dykstra's algorithm where pairs share categories.

    Raises:
        ValueError, TypeError: sizes, ranges or orders that mean nothing, by name and value.

    Example:
        >>> CategoricalConfig(3, order=((0, 1), (1, 2))).n_categories
        3
    """

    n_categories: int
    order: tuple[tuple[int, int], ...] = ()
    output_range: tuple[float | None, float | None] = (None, None)
    missing_value: int | None = None
    n_iterations: int = 20

    def __post_init__(self) -> None:
        """Refuse sizes, ranges and orders that mean nothing."""
        require_static(self)
        require_count("n_categories", self.n_categories)
        require_count("n_iterations", self.n_iterations)
        require_range("output_range", self.output_range)
        missing = self.missing_value
        if missing is not None and 0 <= missing < self.n_categories:
            raise refusal(
                "missing_value",
                missing,
                f"a number outside 0..{self.n_categories - 1}, since it is a category",
                "use -1",
            )
        _ = self.closure

    @property
    def closure(self) -> np.ndarray:
        """`[i, j]` is true where the output of i must not exceed that of j."""
        return order_closure(self.order, self.n_categories)


def init(key: Key[Array, ""], config: CategoricalConfig) -> CategoricalParams:
    """Outputs drawn uniformly from the output range, then projected onto the order.

    Args:
        key: PRNG key.
        config: the calibrator.

    Returns:
        CategoricalParams; feasible.
    """
    require_key(key)
    low, high = config.output_range
    if low is None:
        low = 0.0 if high is None else high - 1.0
    if high is None:
        high = low + 1.0
    outputs = jax.random.uniform(key, (config.n_categories,), minval=low, maxval=high)
    missing = None if config.missing_value is None else jnp.asarray(0.5 * (low + high), jnp.float32)
    return project(config, CategoricalParams(outputs, missing))


def apply(
    config: CategoricalConfig, params: CategoricalParams, x: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    r"""The output of each category.

    .. math:: c(x) = \sum_i \theta_i \, [x = i]

    Args:
        config: of the calibrator.
        params: of the calibrator.
        x: categories. One that is neither known nor `missing_value` gives NaN.

    Returns:
        The calibrated inputs.

    Example:
        >>> params = CategoricalParams(jnp.array([0.0, 10.0, 20.0]))
        >>> apply(CategoricalConfig(3), params, jnp.array([2, 0])).tolist()
        [20.0, 0.0]
    """
    categories = jnp.arange(config.n_categories, dtype=x.dtype)
    chosen = x[..., None] == categories.reshape((1,) * x.ndim + (-1,))
    outputs = params.outputs.reshape((1,) * x.ndim + (-1,))
    y = jnp.sum(jnp.where(chosen, outputs, 0.0), axis=-1)
    y = jnp.where(jnp.any(chosen, axis=-1), y, jnp.nan)
    if config.missing_value is not None and params.missing is not None:
        y = jnp.where(x == config.missing_value, params.missing, y)
    return y


def project(config: CategoricalConfig, params: CategoricalParams) -> CategoricalParams:
    """The nearest outputs that satisfy order and bounds, by Dykstra and an exact last step.

    Args:
        config: of the calibrator.
        params: of the calibrator.

    Returns:
        CategoricalParams with `check(...) == 0`, here and after an optimizer step that leads here.

    Raises:
        ValueError: the output range holds too few numbers of the type of the parameters.
    """
    closure = config.closure
    sets = pair_projections(closure)
    if not sets and config.output_range == (None, None):
        return params
    y, missing = params.outputs, params.missing
    together = y if missing is None else jnp.concatenate([y, missing[None]])
    place = frame(together, config.output_range)
    if sets:
        moved = dykstra(working(y) - place.centre, sets, config.n_iterations)
        y = (repair_order(moved, closure) + place.centre).astype(working(y).dtype)
    outputs = onto(place, y).astype(params.outputs.dtype)
    if missing is not None:
        missing = onto(place, missing).astype(missing.dtype)
    return CategoricalParams(outputs, missing)


def check(config: CategoricalConfig, params: CategoricalParams) -> Float[Array, ""]:
    """Largest violation of order and bounds; 0 where all hold."""
    y = working(params.outputs)
    gap = jnp.where(config.closure, y[:, None] - y[None, :], 0.0)
    worst = jnp.maximum(jnp.max(gap), 0.0)
    low, high = config.output_range
    for values in (y, params.missing):
        if values is not None and low is not None:
            worst = jnp.maximum(worst, low - jnp.min(values))
        if values is not None and high is not None:
            worst = jnp.maximum(worst, jnp.max(values) - high)
    return worst
