"""Cumulative-distribution layer: rising curves made of many soft steps, fast for many inputs."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_signs,
    require_static,
    require_width,
)

Activation = Literal["relu6", "sigmoid"]
Reduction = Literal["mean", "geometric_mean"]


class CDFParams(NamedTuple):
    """`keypoints` `[output, input, keypoint]`: places of the steps; `scaling` `[output, input]`."""

    keypoints: Float[Array, "o d k"]
    scaling: Float[Array, "o d"]


@dataclasses.dataclass(frozen=True)
class CDFConfig:
    """A layer of n_outputs functions of inputs in [0, 1], monotone in all of them.

    Attributes:
        n_inputs: D; n_outputs: O; n_keypoints: K, steps of each curve.
        monotonicity: -1 or +1 for each input; `None` is all rising.
        activation: shape of a step, `"relu6"` (a ramp from 0 to 1) or `"sigmoid"`.
        reduction: of the inputs' curves, `"mean"` or `"geometric_mean"`.

    Raises:
        ValueError: sizes mean nothing, a free input, an unknown name.
        TypeError: a field is of a wrong type.
    """

    n_inputs: int
    n_outputs: int = 1
    n_keypoints: int = 10
    monotonicity: tuple[int, ...] | None = None
    activation: Activation | str = "relu6"
    reduction: Reduction | str = "mean"

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        require_static(self)
        for name in ("n_inputs", "n_outputs", "n_keypoints"):
            require_count(name, getattr(self, name))
        require_signs("monotonicity", self.monotonicity, self.n_inputs)
        if self.monotonicity is not None and 0 in self.monotonicity:
            raise refusal(
                "monotonicity", self.monotonicity, "-1 or 1 for each input",
                "give free inputs to another layer",
            )  # fmt: skip
        if self.activation not in ("relu6", "sigmoid"):
            raise refusal("activation", self.activation, "'relu6' or 'sigmoid'", "choose one")
        if self.reduction not in ("mean", "geometric_mean"):
            raise refusal("reduction", self.reduction, "'mean' or 'geometric_mean'", "choose one")

    @property
    def signs(self) -> np.ndarray:
        """`[input]` of -1 and 1."""
        return np.asarray(self.monotonicity or (1,) * self.n_inputs)


def init(key: Key[Array, ""], config: CDFConfig) -> CDFParams:
    """Steps at random places of [0, 1], each as wide as their mean distance.

    Returns:
        CDFParams; feasible.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    shape = config.n_outputs, config.n_inputs, config.n_keypoints
    keypoints = jax.random.uniform(key, shape, jnp.float32)
    return CDFParams(keypoints, jnp.full(shape[:2], float(config.n_keypoints), jnp.float32))


def apply(
    config: CDFConfig, params: CDFParams, x: Float[Array, "*batch d"]
) -> Float[Array, "*batch o"]:
    r"""Mean of soft steps of each input, reduced over the inputs.

    .. math::
        c_{od}(x) = \frac{1}{K} \sum_k a\left(\gamma_{od} (s_d x_d - s_d t_{odk})\right), \qquad
        f_o(x) = \frac{1}{D} \sum_d c_{od}(x) \quad\text{or}\quad
        \Big(\prod_d c_{od}(x)\Big)^{1/D}

    Symbols: t is `params.keypoints`; :math:`\gamma \ge 0` is `params.scaling`; s is the direction;
    a is `clip(u + 1/2, 0, 1)` (`relu6`, scaled and shifted) or the logistic function.

    Returns:
        Outputs in [0, 1].

    Raises:
        ValueError: the last axis of `x` is not the number of inputs.

    Source: the layer CDF of TensorFlow Lattice. Deviation: a ramp is centred on its keypoint;
    falling inputs.

    Example:
        >>> config = CDFConfig(1, n_keypoints=2)
        >>> params = CDFParams(jnp.array([[[0.25, 0.75]]]), jnp.array([[4.0]]))
        >>> apply(config, params, jnp.array([[0.0], [0.5], [1.0]])).tolist()
        [[0.0], [0.5], [1.0]]
    """
    require_width(x, config.n_inputs, "cdf.apply")
    signs = jnp.asarray(config.signs, x.dtype)
    lead = (1,) * (x.ndim - 1)
    apart = x[..., None, :, None] - params.keypoints.reshape(*lead, *params.keypoints.shape)
    slope = (signs[None, :] * params.scaling)[..., None]
    u = apart * slope.reshape(*lead, *slope.shape)
    steps = jax.nn.sigmoid(u) if config.activation == "sigmoid" else jnp.clip(u + 0.5, 0.0, 1.0)
    curves = jnp.mean(steps, axis=-1)
    if config.reduction == "mean":
        return jnp.mean(curves, axis=-1)
    # The slope of the logarithm at zero is infinite: a curve that is zero has no say in it.
    tiny = jnp.asarray(1e-12, curves.dtype)
    root = jnp.exp(jnp.mean(jnp.log(jnp.maximum(curves, tiny)), axis=-1))
    return jnp.where(jnp.any(curves <= 0.0, axis=-1), jnp.zeros_like(root), root)


def project(config: CDFConfig, params: CDFParams) -> CDFParams:
    r"""The nearest parameters with :math:`\gamma \ge 0`; exact in every floating type."""
    return params._replace(scaling=jnp.maximum(params.scaling, jnp.zeros_like(params.scaling)))


def check(config: CDFConfig, params: CDFParams) -> Float[Array, ""]:
    """The largest violation: how far a scaling lies below zero."""
    return jnp.maximum(-jnp.min(params.scaling), jnp.zeros((), params.scaling.dtype))
