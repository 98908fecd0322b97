"""Projection as part of an optax optimizer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from fusion.lattice.checks import refusal
from fusion.lattice.tagged import project_tree


def with_projection(
    optimizer: optax.GradientTransformation, project: Callable[[Any], Any] = project_tree
) -> optax.GradientTransformationExtraArgs:
    r"""An optimizer whose step ends on the constraints.

    .. math:: u' = P(\theta + u) - \theta

    Symbols: :math:`\theta` are the parameters; :math:`u` is the update of `optimizer`;
    :math:`P` is `project`; :math:`u'` is the update that is returned, ready for
    `optax.apply_updates`.

    It composes with `optax.chain`, as its last member: what scales the update afterwards would
    leave the constraints. Inside `optax.masked`, `optax.partition` and `optax.MultiSteps` it
    projects the layers that it sees. The moments of the inner optimizer see the gradient only, not
    the projection. Projections end on steps that survive the rounding of :math:`\theta + u'`
    (`fusion.lattice.rounding`), so that the violation after `optax.apply_updates` is exactly zero.

    Args:
        optimizer: any optax transformation that yields updates to add.
        project: from parameters to feasible parameters of the same structure. Without it every
            tagged layer of the tree is projected; for plain parameters for example
            `lambda p: deep_lattice.project(config, p)`, vmapped where parameters are.

    Returns:
        The optax transformation; `update` needs `params`.

    Raises:
        ValueError: `update` is called without `params`.

    Source: projected (sub)gradient methods, e.g. Bertsekas (1999), Nonlinear programming,
    section 2.3; with an adaptive optimizer as in Gupta et al. (2016).

    Example:
        >>> optimizer = with_projection(optax.sgd(1.0), lambda p: jnp.maximum(p, 0.0))
        >>> params = jnp.array([1.0, 2.0])
        >>> updates, _ = optimizer.update(jnp.array([3.0, 0.5]), optimizer.init(params), params)
        >>> optax.apply_updates(params, updates).tolist()
        [0.0, 1.5]
    """
    inner = optax.with_extra_args_support(optimizer)

    def update(
        updates: optax.Updates,
        state: optax.OptState,
        params: optax.Params | None = None,
        **extra: Any,
    ) -> tuple[optax.Updates, optax.OptState]:
        if params is None:
            raise refusal(
                "params",
                None,
                "the parameters, which are projected",
                "call optimizer.update(grads, state, params)",
            )
        updates, state = inner.update(updates, state, params, **extra)
        moved = project(optax.apply_updates(params, updates))
        return jax.tree.map(_difference, moved, params, updates, is_leaf=_is_masked), state

    return optax.GradientTransformationExtraArgs(inner.init, update)


def _is_masked(node: Any) -> bool:
    return isinstance(node, optax.MaskedNode)


def _difference(moved: Any, before: Any, update: Any) -> Any:
    """The update, in its own type; nothing where optax has masked the parameter out."""
    return before if _is_masked(before) else jnp.subtract(moved, before).astype(update.dtype)
