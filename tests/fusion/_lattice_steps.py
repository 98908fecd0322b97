"""Steps of an optimizer along random gradients, and what they leave of the constraints."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import optax

from fusion.lattice.tagged import check_tree


def violations(params: Any, optimizer: optax.GradientTransformation, steps: int) -> np.ndarray:
    """Largest violation in a tree of flax parameters after each step."""

    def step(carry: tuple, key: jax.Array) -> tuple:
        params, state = carry
        grads = jax.tree.map(lambda a: jax.random.normal(key, a.shape, a.dtype), params)
        updates, state = optimizer.update(grads, state, params)
        params = optax.apply_updates(params, updates)
        return (params, state), check_tree(params)

    @jax.jit
    def run(params: Any) -> jax.Array:
        keys = jax.random.split(jax.random.key(1), steps)
        return jax.lax.scan(step, (params, optimizer.init(params)), keys)[1]

    return np.asarray(run(params))
