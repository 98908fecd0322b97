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
from fusion.lattice.curvature import bent, curvature, project_bent
from fusion.lattice.projections import isotonic
from fusion.lattice.rounding import frame, onto, working


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
        convexity: -1 (concave), 0 (free) or +1 (convex), for all inputs or one for each; beside
            any monotonicity.
        keypoints: positions for each input, in place of the even spacing, e.g. from
            `quantile_keypoints`.
        learned_keypoints: learn where the inner keypoints are; the outer two stay.
        missing_value: inputs equal to this (`nan` is allowed) get a learned output of their own.
        n_iterations: passes of Dykstra's algorithm, where calibrators are convex or concave.

    Raises:
        ValueError: sizes, ranges or directions mean nothing.
        TypeError: a field is of a wrong type, such as a list for a tuple.

    Example:
        >>> PWLConfig(2, 3, input_range=(0.0, 4.0), monotonicity=(1, 0)).start.tolist()
        [[0.0, 2.0, 4.0], [0.0, 2.0, 4.0]]
    """

    n_inputs: int
    n_keypoints: int = 10
    input_range: tuple[float, float] | tuple[tuple[float, float], ...] = (0.0, 1.0)
    monotonicity: int | tuple[int, ...] = 0
    output_range: tuple[float | None, float | None] = (None, None)
    keypoints: tuple[tuple[float, ...], ...] | None = None
    learned_keypoints: bool = False
    missing_value: float | None = None
    convexity: int | tuple[int, ...] = 0
    n_iterations: int = 20

    def __post_init__(self) -> None:
        """Refuse sizes, ranges and directions that mean nothing."""
        require_static(self)
        require_count("n_inputs", self.n_inputs)
        require_count("n_keypoints", self.n_keypoints, 2)
        require_count("n_iterations", self.n_iterations)
        for name in ("monotonicity", "convexity"):
            given = getattr(self, name)
            row = given if isinstance(given, tuple) else (given,) * self.n_inputs
            require_signs(name, row, self.n_inputs)
        if self.learned_keypoints and np.any(self.bends):
            raise refusal(
                "learned_keypoints", True, "False beside convexity", "give keypoints from the data"
            )
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
    def bends(self) -> np.ndarray:
        """`[n_inputs]` of -1 (concave), 0, 1 (convex)."""
        return np.broadcast_to(np.asarray(self.convexity, np.int64), (self.n_inputs,))

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
    params = PWLParams(jnp.asarray(outputs, jnp.float32), spacing, missing)
    return params if _free(config) else project(config, params)


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


def project(config: PWLConfig, params: PWLParams) -> PWLParams:
    r"""The nearest calibrators that satisfy monotonicity, convexity and bounds.

    Without convexity this is exact: isotonic regression, then clipping, since the projection onto
    monotone sequences within constant bounds is the clipped projection onto monotone sequences.
    With it, Dykstra's algorithm tends to the nearest calibrators, and a last step makes them
    feasible.

    Args:
        config: of the layer.
        params: of the layer.

    Returns:
        PWLParams with `check(...) == 0`, here and after an optimizer step that leads here.

    Raises:
        ValueError: the output range holds too few numbers of the type of the parameters.
    """
    if _free(config):
        return params
    y, missing = params.outputs, params.missing
    bends, signs = config.bends, config.signs
    row = y if missing is None else jnp.concatenate([y, missing[:, None]], axis=-1)
    ramp, least = bent(config.start, signs, bends)
    place = frame(row, config.output_range, axis=-1, least=least)
    if np.any(bends):
        outputs = project_bent(
            y, place, config.start, signs, bends, ramp, n_iterations=config.n_iterations
        )
    else:
        outputs = _isotonic_rows(working(y) - place.centre, signs) + place.centre
    outputs = onto(place, outputs).astype(y.dtype)
    if missing is not None:
        missing = onto(place, working(missing)[:, None])[:, 0].astype(missing.dtype)
    return PWLParams(outputs, params.spacing, missing)


def _free(config: PWLConfig) -> bool:
    nothing = config.output_range == (None, None)
    return nothing and not np.any(config.signs) and not np.any(config.bends)


def _isotonic_rows(y: Array, signs: np.ndarray) -> Array:
    """Isotonic regression of the rows that have a sign, antitonic for -1."""
    if not np.any(signs):
        return y
    # Only the rows from the first monotone input to the last: put them side by side.
    monotone = np.flatnonzero(signs)
    rows = slice(int(monotone[0]), int(monotone[-1]) + 1)
    part, bound = y[rows], signs[rows, None]
    direction = jnp.asarray(np.where(bound < 0, -1, 1), y.dtype)
    ordered = isotonic(part * direction) * direction
    if not bound.all():
        ordered = jnp.where(np.broadcast_to(bound != 0, part.shape), ordered, part)
    return jnp.concatenate([y[: rows.start], ordered, y[rows.stop :]])


def check(config: PWLConfig, params: PWLParams) -> Float[Array, ""]:
    """Largest violation of monotonicity, convexity and bounds; 0 where all constraints hold."""
    y = working(params.outputs)
    signs = jnp.asarray(config.signs[:, None], y.dtype)
    worst = jnp.maximum(0.0, jnp.max(-signs * jnp.diff(y, axis=-1)))
    if np.any(config.bends) and config.n_keypoints > 2:
        bends = jnp.asarray(config.bends[:, None], y.dtype)
        worst = jnp.maximum(worst, jnp.max(-bends * curvature(y, config.start)))
    low, high = config.output_range
    for values in (y, params.missing):
        if values is not None and low is not None:
            worst = jnp.maximum(worst, low - jnp.min(working(values)))
        if values is not None and high is not None:
            worst = jnp.maximum(worst, jnp.max(working(values)) - high)
    return worst
