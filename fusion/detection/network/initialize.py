r"""Fresh weights of a flax module, all drawn at once.

.. math:: W \sim \mathcal N(0, 2 / n_{in}), \quad b = 0

Flax draws layer by layer, and compiling one generator for each of fifty layers takes longer than
the first hundred steps of a small detector. One draw for all of them compiles in a second.

Source: He et al. (2015), for layers before a ReLU.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray


def _name(path: Any) -> tuple[str, ...]:
    return tuple(str(getattr(entry, "key", entry)) for entry in path)


def init_weights(
    key: PRNGKeyArray, module: nn.Module, *inputs: Any, scales: Mapping[str, float] | None = None
) -> Any:
    """Variables of a module for inputs of these shapes.

    Args:
        key: of the draw.
        module: its own initializers are not used.
        inputs: arguments of `__call__`; `jax.ShapeDtypeStruct` for arrays.
        scales: layer name -> standard deviation that replaces the formula's, such as that of
            output layers.

    Returns:
        `{"params": ..., ...}`; kernels as drawn, scales and variances one, whitening matrices the
        identity, all else zero.
    """
    scales = scales or {}
    shapes = jax.eval_shape(lambda k: module.lazy_init(k, *inputs), key)
    leaves, tree = jax.tree_util.tree_flatten_with_path(shapes)
    kernels = [leaf.size if _name(path)[-1] == "kernel" else 0 for path, leaf in leaves]
    ends = np.cumsum(kernels)
    noise = jax.random.normal(key, (int(ends[-1]),))
    out = []
    for (path, leaf), size, end in zip(leaves, kernels, ends.tolist(), strict=True):
        name = _name(path)
        if size:
            fan_in = math.prod(leaf.shape[:-1])
            sd = scales.get(name[-2], math.sqrt(2.0 / fan_in))
            out.append(sd * noise[end - size : end].reshape(leaf.shape))
        elif name[-1].endswith("_whiten"):
            out.append(jnp.eye(leaf.shape[0], dtype=leaf.dtype))
        else:
            one = name[-1] in ("scale", "var")
            # An explicit dtype: a weak one would change after the first step, and compile it again.
            out.append(jnp.full(leaf.shape, 1.0 if one else 0.0, leaf.dtype))
    return jax.tree_util.tree_unflatten(tree, out)
