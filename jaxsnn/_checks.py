"""Checks of what a user gives, all with one grammar: `name=value: expected ...; fix`.

Values that are traced pass: inside jit nothing can be looked at.
"""

from __future__ import annotations

import numbers
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def default_float() -> Any:
    """The dtype that states are made in: float32, or float64 under `jax.enable_x64`."""
    return jnp.result_type(float)


def concrete(value: Any) -> np.ndarray | None:
    """The value as numbers, or None when it is traced: inside jit nothing can be checked."""
    if isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def require(condition: bool, message: str) -> None:
    """Raise ValueError with `message` unless the condition holds."""
    if not condition:
        raise ValueError(message)


def require_choice(name: str, value: Any, allowed: Collection[Any]) -> None:
    """`value` is one of `allowed`."""
    if value not in allowed:
        words = ", ".join(map(repr, allowed))
        raise ValueError(f"{name}={value!r}: expected one of {words}; choose one of them")


def require_whole(name: str, value: Any, least: int, fix: str) -> None:
    """`value` is a whole number >= `least`.

    Raises:
        TypeError: it is no integer (104.0 is none).
        ValueError: it is too small.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise TypeError(f"{name}={value!r}: expected a whole number; write it without a point")
    if value < least:
        raise ValueError(f"{name}={value}: expected a whole number >= {least}; {fix}")


def require_count(name: str, value: Any, least: int, fix: str) -> None:
    """As `require_whole`, for a number that may be an array or traced; the latter passes."""
    given = concrete(value)
    if given is not None:
        require_whole(name, given.item() if given.ndim == 0 else value, least, fix)


def require_positive(name: str, value: Any, fix: str, *, zero: bool = False) -> None:
    """`value` (any shape) is finite and > 0 (or >= 0); traced values pass."""
    given = concrete(value)
    if given is None:
        return
    good = np.isfinite(given) & ((given >= 0) if zero else (given > 0))
    if not good.all():
        bound = ">= 0" if zero else "> 0"
        raise ValueError(f"{name}={given[~good].flat[0]}: expected a number {bound}; {fix}")


def require_finite(name: str, value: Any, fix: str) -> None:
    """`value` (any shape) has no NaN and no infinity; traced values pass."""
    given = concrete(value)
    if given is None:
        return
    good = np.isfinite(given)
    if not good.all():
        what = f"{given[~good].flat[0]}"
        if given.ndim:
            what += f" in {int((~good).sum())} of {good.size} values"
        raise ValueError(f"{name}={what}: expected finite numbers; {fix}")


def require_circles(name: str, given: Any, probs: Any) -> None:
    """`given` (any shape) are start circles of the map, or negative for a draw.

    What is traced passes; where the map alone is traced, its size still counts.

    Args:
        name: of the argument.
        given: numbers of start circles.
        probs: `WorldParams.start_probs`, `[k]`, or `[maps, k]`: then all maps have the circles.

    Raises:
        TypeError: they are no whole numbers.
        ValueError: a map does not draw from one of them.
    """
    dtype = given.dtype if hasattr(given, "dtype") else np.asarray(given).dtype
    if np.size(given) and not jnp.issubdtype(dtype, jnp.integer):
        raise TypeError(
            f"{name}=<{dtype}>: expected whole numbers; count start circles from 0, or give -1 "
            "for a draw"
        )
    numbers, chances = concrete(given), concrete(probs)
    if numbers is None:
        return
    known = np.arange(np.shape(probs)[-1])
    if chances is not None:
        known = np.flatnonzero(np.atleast_2d(chances).min(axis=0) > 0)
    wrong = np.atleast_1d(numbers)[np.atleast_1d((numbers >= 0) & ~np.isin(numbers, known))]
    if wrong.size:
        what = wrong[:1].tolist() if numbers.ndim else wrong[0]
        raise ValueError(
            f"{name}={what}: expected numbers of start circles of the map, {known.tolist()}, or "
            "negative ones for a draw; count from 0"
        )


def require_mapped(name: str, axes: Any, tree: Any, robots: int) -> None:
    """Leaves of `tree` that each robot has for itself lead with robots.

    Args:
        name: of the tree; that of the axes is `name_axis`.
        axes: 0, None, or a tree of them for some leaves only, as in `jax.vmap`.
        tree: the leaves.
        robots: how many there are.

    Raises:
        ValueError: an axis is neither 0 nor None, the axes do not fit the tree, or a leaf has
            not one entry for each robot.
    """

    def none(axis: Any) -> bool:
        return axis is None

    def check(path: Any, axis: Any, part: Any) -> None:
        at = jax.tree_util.keystr(path)
        require(
            axis is None or (axis == 0 and not isinstance(axis, bool)),
            f"{name}_axis{at}={axis!r}: expected 0 or None; put robots first with jnp.moveaxis",
        )
        if axis is None:
            return
        for below, leaf in jax.tree_util.tree_leaves_with_path(part):
            shape = jnp.shape(leaf)
            require(
                shape[:1] == (robots,),
                f"{name}{at}{jax.tree_util.keystr(below)}=<shape {shape}>: expected {robots} "
                "first, one for each key; give each robot its own",
            )

    form = jax.tree.structure(axes, is_leaf=none)
    try:
        form.flatten_up_to(tree)  # type: ignore[attr-defined]  # missing in the stubs
    except ValueError as error:
        raise ValueError(
            f"{name}_axis={axes!r}: expected 0, None, or a tree of them as {name} begins; build "
            f"it from {name} itself, with _replace"
        ) from error
    jax.tree_util.tree_map_with_path(check, axes, tree, is_leaf=none)


def require_key(key: Any, name: str = "key") -> None:
    """`key` is one typed key, as `jax.random.key` makes it."""
    _require_typed(key, name)
    require(
        key.ndim == 0,
        f"{name}=<{key.shape} keys>: expected a single key; vmap over them or take one",
    )


def require_keys(keys: Any, name: str = "keys") -> None:
    """`keys` are typed keys along one axis, at least one."""
    _require_typed(keys, name)
    require(
        keys.ndim == 1 and keys.shape[0] > 0,
        f"{name}=<shape {keys.shape}>: expected one key per robot, at least one; use "
        "jax.random.split(jax.random.key(seed), robots)",
    )


def typed_key(key: Any) -> Any:
    """A typed key from either kind: other libraries hand out raw uint32 words."""
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return key
    return jax.random.wrap_key_data(key)


def _require_typed(key: Any, name: str) -> None:
    dtype = getattr(key, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        what = f"<{dtype or type(key).__name__}>"
        raise ValueError(f"{name}={what}: expected a typed key; use jax.random.key(seed)")
