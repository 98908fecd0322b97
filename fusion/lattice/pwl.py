"""Piecewise-linear calibrators: one learned one-dimensional function per input."""

from __future__ import annotations

import dataclasses
import math
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
from fusion.lattice.projections import MARGIN, isotonic, tilt

__all__ = ["PWLConfig", "PWLParams", "apply", "check", "init", "keypoints", "project"]


class PWLParams(NamedTuple):
    """What is learned by a layer of calibrators.

    `outputs` `[n_inputs, n_keypoints]`: the value at each keypoint, as it is, not as differences.
    `spacing` `[n_inputs, n_keypoints - 1]`: logits of the distances between learned keypoints,
    `None` where keypoints are fixed. `missing` `[n_inputs]`: the value for a missing input,
    `None` where inputs are never missing.
    """

    outputs: Array
    spacing: Array | None = None
    missing: Array | None = None


@dataclasses.dataclass(frozen=True)
class PWLConfig:
    """A layer of piecewise-linear calibrators, one for each input.

    Attributes:
        n_inputs: number of inputs, each with a calibrator of its own.
        n_keypoints: keypoints of each calibrator, at least 2.
        input_range: `(low, high)` of all inputs, or one such pair for each input. Keypoints are
            spaced evenly; inputs outside are clipped.
        monotonicity: -1 (non-increasing), 0 (free) or +1 (non-decreasing), for all inputs or one
            for each.
        output_range: `(low, high)`, either of which may be `None` (no bound).
        keypoints: positions for each input, in place of the even spacing, e.g. quantiles.
        learned_keypoints: learn where the inner keypoints are; the outer two stay.
        missing_value: inputs equal to this (`nan` is allowed) get a learned output of their own.
    """

    n_inputs: int
    n_keypoints: int = 10
    input_range: tuple[float, float] | tuple[tuple[float, float], ...] = (0.0, 1.0)
    monotonicity: int | tuple[int, ...] = 0
    output_range: tuple[float | None, float | None] = (None, None)
    keypoints: tuple[tuple[float, ...], ...] | None = None
    learned_keypoints: bool = False
    missing_value: float | None = None

    def __post_init__(self) -> None:
        """Refuse sizes, ranges and directions that mean nothing."""
        require_static(self)
        require_count("n_inputs", self.n_inputs)
        require_count("n_keypoints", self.n_keypoints, 2)
        given = self.monotonicity
        require_signs(
            "monotonicity", given if isinstance(given, tuple) else (given,) * self.n_inputs,
            self.n_inputs,
        )  # fmt: skip
        require_range("output_range", self.output_range)
        shape = (self.n_inputs, self.n_keypoints)
        if self.keypoints is not None:
            positions = np.asarray(self.keypoints, np.float64)
            if positions.shape != shape or not np.all(np.diff(positions) > 0):
                raise refusal(
                    "keypoints",
                    self.keypoints,
                    f"{shape[0]} tuples of {shape[1]} positions that increase strictly",
                    "drop repeated quantiles",
                )
        else:
            ranges = np.asarray(self.input_range, np.float64)
            if ranges.shape not in ((2,), (self.n_inputs, 2)) or not np.all(
                np.diff(ranges, axis=-1) > 0
            ):
                raise refusal(
                    "input_range",
                    self.input_range,
                    "(low, high) with low < high, or one such pair for each of "
                    f"{self.n_inputs} inputs",
                    "take them from the smallest and largest values of the data",
                )

    @property
    def signs(self) -> np.ndarray:
        """`[n_inputs]` of -1, 0, 1."""
        return np.broadcast_to(np.asarray(self.monotonicity, np.int64), (self.n_inputs,))

    @property
    def start(self) -> np.ndarray:
        """`[n_inputs, n_keypoints]`: the keypoints before any learning."""
        if self.keypoints is not None:
            return np.asarray(self.keypoints, np.float64)
        ranges = np.broadcast_to(np.asarray(self.input_range, np.float64), (self.n_inputs, 2))
        return np.linspace(ranges[:, 0], ranges[:, 1], self.n_keypoints, axis=-1)


def init(key: Key[Array, ""], config: PWLConfig) -> PWLParams:
    """Straight lines across the output range (the identity where a bound is missing).

    Args:
        key: decides nothing, calibrators start alike; taken so that all layers are called the
            same way.
        config: the layer.

    Returns:
        PWLParams; feasible.
    """
    require_key(key)
    start, signs = config.start, config.signs
    low, high = config.output_range
    fraction = (start - start[:, :1]) / (start[:, -1:] - start[:, :1])
    fraction = np.where(signs[:, None] < 0, 1 - fraction, fraction)
    width = start[:, -1:] - start[:, :1]
    if low is None and high is None:
        outputs = np.where(signs[:, None] < 0, -start, start)
    elif low is None:
        outputs = high - width * (1 - fraction)
    elif high is None:
        outputs = low + width * fraction
    else:
        outputs = low + (high - low) * fraction
    spacing = missing = None
    if config.learned_keypoints:
        spacing = jnp.asarray(np.log(np.diff(start) / width), jnp.float32)
    if config.missing_value is not None:
        missing = jnp.asarray(outputs.mean(axis=-1), jnp.float32)
    return project(config, PWLParams(jnp.asarray(outputs, jnp.float32), spacing, missing))


def keypoints(
    config: PWLConfig, params: PWLParams
) -> tuple[Float[Array, "n_inputs n_keypoints"], Float[Array, "n_inputs n_keypoints"]]:
    """Positions and outputs of the keypoints: the points one would plot.

    Example:
        >>> config = PWLConfig(1, n_keypoints=3, output_range=(0.0, 4.0))
        >>> x, y = keypoints(config, init(jax.random.key(0), config))
        >>> x.tolist()
        [[0.0, 0.5, 1.0]]
    """
    start = jnp.asarray(config.start, params.outputs.dtype)
    if params.spacing is None:
        return start, params.outputs
    low, high = start[:, :1], start[:, -1:]
    inner = low + (high - low) * jnp.cumsum(jax.nn.softmax(params.spacing, axis=-1), axis=-1)
    return jnp.concatenate([low, inner[:, :-1], high], axis=-1), params.outputs


def apply(
    config: PWLConfig, params: PWLParams, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch n_inputs"]:
    r"""Each input through its own piecewise-linear function.

    .. math:: c(x) = y_1 + \sum_{i=1}^{n-1} (y_{i+1} - y_i)
        \; \mathrm{clip}\!\left(\frac{x - k_i}{k_{i+1} - k_i}, 0, 1\right)

    Symbols: :math:`k_i, y_i` are the `keypoints` and their outputs; :math:`n` is `n_keypoints`.
    The sum runs over ramps, without a search for the segment: no gather, and a sum of
    non-decreasing terms, so rounding cannot break monotonicity.

    Args:
        config: of the layer.
        params: of the layer.
        x: inputs; outside the keypoints the function is constant.

    Returns:
        The calibrated inputs.

    Raises:
        ValueError: the last axis of `x` is not `n_inputs`.

    Source: Gupta et al. (2016), Monotonic calibrated interpolated look-up tables, section 3.1.
    """
    require_width(x, config.n_inputs, "pwl.apply")
    where, outputs = keypoints(config, params)
    lead = (1,) * (x.ndim - 1)
    left = where[:, :-1].reshape(*lead, config.n_inputs, -1)
    inverse = (1.0 / (where[:, 1:] - where[:, :-1])).reshape(left.shape)
    rise = (outputs[:, 1:] - outputs[:, :-1]).reshape(left.shape)
    inside = x
    if params.missing is not None:
        # A NaN must not reach the ramps: it would poison their gradient even where not selected.
        absent = _absent(config, x)
        inside = jnp.where(absent, jnp.zeros_like(x), x)
    ramps = jnp.clip((inside[..., None] - left) * inverse, 0.0, 1.0)
    y = outputs[:, 0].reshape(*lead, -1) + jnp.sum(ramps * rise, axis=-1)
    if params.missing is not None:
        y = jnp.where(absent, jnp.broadcast_to(params.missing.reshape(*lead, -1), y.shape), y)
    return y


def _absent(config: PWLConfig, x: Array) -> Array:
    value = config.missing_value
    if value is None:
        raise refusal(
            "missing_value", value, "a number or nan, since params hold outputs for missing inputs",
            "use the configuration that the parameters were made with",
        )  # fmt: skip
    return jnp.isnan(x) if math.isnan(value) else x == value


def project(config: PWLConfig, params: PWLParams, *, margin: float = MARGIN) -> PWLParams:
    r"""The nearest calibrators that satisfy monotonicity and bounds (Euclidean, exact).

    Isotonic regression, then clipping: the projection onto monotone sequences within constant
    bounds is the clipped projection onto monotone sequences.

    Args:
        config: of the layer.
        params: of the layer.
        margin: slack to leave, in float32 epsilons of the largest output; 0 for none.

    Returns:
        PWLParams with `check(...) == 0`.
    """
    y = params.outputs
    signs = config.signs[:, None]
    slack = tilt(y, margin)
    last = config.n_keypoints - 1
    rank = np.where(signs >= 0, np.arange(last + 1), last - np.arange(last + 1)) * np.abs(signs)
    lift = slack * jnp.asarray(rank, y.dtype)
    y = y - lift
    if np.any(signs):
        # Only the rows from the first monotone input to the last: put them side by side.
        monotone = np.flatnonzero(config.signs)
        rows = slice(int(monotone[0]), int(monotone[-1]) + 1)
        part, bound = y[rows], signs[rows]
        direction = jnp.asarray(np.where(bound < 0, -1, 1), y.dtype)
        ordered = isotonic(part * direction) * direction
        if not bound.all():
            ordered = jnp.where(np.broadcast_to(bound != 0, part.shape), ordered, part)
        y = jnp.concatenate([y[: rows.start], ordered, y[rows.stop :]])
    y = _clip(config, y, slack, jnp.asarray(last * np.abs(signs), y.dtype)) + lift
    missing = params.missing
    if missing is not None:
        missing = _clip(config, missing, slack, None)
    return PWLParams(y, params.spacing, missing)


def _clip(config: PWLConfig, y: Array, slack: Array, ranks: Array | None) -> Array:
    low, high = config.output_range
    if low is not None:
        y = jnp.maximum(y, low + slack)
    if high is not None:
        ceiling = high - slack if ranks is None else high - slack * (ranks + 1.0)
        y = jnp.minimum(y, ceiling)
    return y


def check(config: PWLConfig, params: PWLParams) -> Float[Array, ""]:
    """Largest violation of monotonicity and bounds; 0 where all constraints hold."""
    y = params.outputs
    signs = jnp.asarray(config.signs[:, None], y.dtype)
    worst = jnp.maximum(0.0, jnp.max(-signs * jnp.diff(y, axis=-1)))
    low, high = config.output_range
    for values in (y, params.missing):
        if values is not None and low is not None:
            worst = jnp.maximum(worst, low - jnp.min(values))
        if values is not None and high is not None:
            worst = jnp.maximum(worst, jnp.max(values) - high)
    return worst
