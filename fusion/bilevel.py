"""Learned targets that are judged by rows which the gate did not learn from.

In Equation 3.2 no gradient of the main loss reaches the targets f: the beta term makes f imitate
the weights. Here f is trained by what its targets lead to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Params = dict[str, Any]
Batch = tuple[Array, ...]


def held_out_gradient(
    params: Params,
    batch: Batch,
    rate: float | Array,
    *,
    penalized: Callable[[Params, Batch], Float[Array, ""]],
    main: Callable[[Params, Batch], Float[Array, ""]],
) -> Any:
    r"""Gradient of the main loss after one step, in the parameters of the targets.

    .. math::
        \nabla_f\, L^{B}_{main}\left(\theta - \eta \nabla_\theta L^{A}(\theta, f)\right)

    A is the first half of the batch, B the second: the step is unrolled, and differentiated.

    Args:
        params: with the targets' under `"targets"`.
        batch: arrays with the examples first.
        rate: of the step.
        penalized: whole loss of parameters and a batch; main: the main loss alone.

    Returns:
        A tree like `params["targets"]`.

    Source: Liu et al. (2019), DARTS, the unrolled step; Shim (2020), Eq. 3.2, for f.
    """
    half = batch[0].shape[0] // 2
    first, second = (tuple(a[part] for a in batch) for part in (slice(half), slice(half, 2 * half)))
    rest = {name: tree for name, tree in params.items() if name != "targets"}

    def after(targets: Any) -> Array:
        slope = jax.grad(lambda p: penalized(p | {"targets": targets}, first))(rest)
        moved = jax.tree.map(lambda p, g: p - jnp.asarray(rate, p.dtype) * g, rest, slope)
        return main(moved | {"targets": targets}, second)

    return jax.grad(after)(params["targets"])
