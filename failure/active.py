"""Which features are active, and which transistors they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from failure import revnet
from failure.feature_ranking import active_features
from failure.rev_argate import RevArgateConfig, RevArgateParams, fusion_weights


class Activity(NamedTuple):
    """Result of `activity`.

    Attributes:
        weights: `[D]`, mean fusion weight of every feature.
        order: `[D]`, features by falling weight.
        n_active: how many of them are active.
        sensitivity: `[D, D]`, share of parameter j in feature k; rows sum to one.
        parameters: `[D]`, weight of every parameter, the sum is one.
    """

    weights: np.ndarray
    order: np.ndarray
    n_active: int
    sensitivity: np.ndarray
    parameters: np.ndarray


def activity(
    config: RevArgateConfig,
    params: RevArgateParams,
    x: Float[Array, "n d"],
    *,
    share: float | None = None,
    rows: int = 64,
) -> Activity:
    r"""Trace the fusion weights of the features back to the parameters.

    .. math:: s_{kj} = \frac{\overline{|\partial x_j / \partial z_k|}}
        {\sum_i \overline{|\partial x_i / \partial z_k|}}, \qquad a_j = \sum_k \bar w_k s_{kj}

    with the Jacobian of the inverse network, :math:`x = g^{-1}(z)`, averaged over rows of the data.

    Args:
        config: of the trained network.
        params: its weights.
        x: inputs, unit variance.
        share: rule of the active features, see `failure.feature_ranking.active_features`.
        rows: rows that the Jacobian is averaged over.

    Returns:
        Activity.

    Source: Shim (2020), Section 4.3, for the ranking by fusion weights. Deviation: the source
    names active features only; the step from features to transistors is ours.
    """
    of_rows = fusion_weights(config, params, x)
    order, n_active = active_features(of_rows, share)
    weights = np.asarray(of_rows, np.float64).mean(0)
    z = revnet.forward(params.network, x[:rows])

    def back(z: Array) -> Array:
        return revnet.inverse(params.network, z)

    jacobian = np.abs(np.asarray(jax.jit(jax.vmap(jax.jacfwd(back)))(z), np.float64)).mean(0).T
    sensitivity = jacobian / jacobian.sum(1, keepdims=True)
    weights = weights / weights.sum()
    return Activity(weights, order, n_active, sensitivity, weights @ sensitivity)


def by_transistor(names: Sequence[tuple[str, str]], values: np.ndarray) -> dict[str, float]:
    """Sum one value per parameter over the parameters of each transistor, largest first.

    Example:
        >>> by_transistor([("M1", "vth"), ("M2", "vth"), ("M2", "tox")], np.array([0.2, 0.5, 0.3]))
        {'M2': 0.8, 'M1': 0.2}
    """
    total: dict[str, float] = {}
    for (name, _), value in zip(names, values, strict=True):
        total[name] = total.get(name, 0.0) + float(value)
    return dict(sorted(total.items(), key=lambda item: -item[1]))
