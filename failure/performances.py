"""Performance functions: one output per sample, traced or called back, with or without slopes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# x [n, D] -> y [n]
Performance = Callable[[Any], Any]
# x [n, D] -> (y [n], dy/dx [n, D])
Slopes = Callable[[Any], tuple[Any, Any]]


def check_rows(y: Any, x: Any) -> None:
    """Refuse outputs that are not one per row: broadcast, one would stand for all samples.

    The shapes are static, so that the check holds for traced values as well.

    Args:
        y: what a performance function gave.
        x: `[n, D]`, what it was given.

    Raises:
        ValueError: `y` is not `[n]`.

    Example:
        >>> check_rows(np.zeros(1), np.zeros((4, 2)))
        Traceback (most recent call last):
        ValueError: performance: y.shape=(1,): expected (4,), one value per row
    """
    if np.shape(y) != np.shape(x)[:1]:
        raise ValueError(
            f"performance: y.shape={np.shape(y)}: expected {np.shape(x)[:1]}, one value per row"
        )


@lru_cache(maxsize=32)
def traceable(performance: Performance, dim: int) -> Performance:
    """The function itself where jax can trace it; else one that calls it back from the program.

    Args:
        performance: `x [n, D] -> y [n]`.
        dim: D.
    """
    try:
        with jax.enable_x64(True):
            jax.eval_shape(performance, jax.ShapeDtypeStruct((2, dim), jnp.float64))
        return performance
    except (jax.errors.JAXTypeError, TypeError):
        pass

    # Words, not numbers, go to and fro: a callback runs in a thread of its own, where jax would
    # round float64 to float32.
    def on_host(words: Any) -> np.ndarray:
        x = np.ascontiguousarray(words).view(np.float64)[..., 0]
        y = np.asarray(performance(x), np.float64)
        check_rows(y, x)
        return np.ascontiguousarray(y)[:, None].view(np.uint32)

    def called(x: Any) -> Any:
        words = jax.lax.bitcast_convert_type(x, jnp.uint32)
        shape = jax.ShapeDtypeStruct((x.shape[0], 2), jnp.uint32)
        return jax.lax.bitcast_convert_type(jax.pure_callback(on_host, shape, words), jnp.float64)

    return called


def slopes_by_jax(performance: Performance) -> Slopes:
    """Values and gradients of a traceable function, `x [n, D] -> (y [n], dy/dx [n, D])`.

    Example:
        >>> y, g = slopes_by_jax(lambda x: x[:, 0] ** 2)(np.array([[3.0, 1.0]]))
        >>> np.asarray(y).tolist(), np.asarray(g).tolist()
        ([9.0], [[6.0, 0.0]])
    """
    one = jax.value_and_grad(lambda x: performance(x[None])[0])
    program = jax.jit(jax.vmap(one))

    def slopes(x: Any) -> tuple[Any, Any]:
        with jax.enable_x64(True):
            return program(jnp.asarray(x, jnp.float64))

    return slopes


class Counted:
    """A performance function with optional gradients that counts what is spent.

    Attributes:
        n_values: simulations without a gradient.
        n_gradients: simulations with one.
        n_invalid: outputs that were not finite.
    """

    def __init__(self, performance: Performance, slopes: Slopes | None = None) -> None:
        self._performance, self._slopes = performance, slopes
        self.n_values = self.n_gradients = self.n_invalid = 0
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def has_slopes(self) -> bool:
        """Whether gradients come with the values."""
        return self._slopes is not None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values `[n]` of `x [n, D]`, NaN where invalid."""
        with jax.enable_x64(True):
            y = np.array(self._performance(jnp.asarray(x)), np.float64)
        check_rows(y, x)
        self.n_values += len(x)
        self.n_invalid += int(np.sum(~np.isfinite(y)))
        y = np.where(np.isfinite(y), y, np.nan)
        self._seen.append((np.array(x, np.float64), y))
        return y

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values `[n]` and gradients `[n, D]`, NaN where either is invalid."""
        assert self._slopes is not None
        with jax.enable_x64(True):
            y, g = self._slopes(jnp.asarray(x))
        y, g = np.array(y, np.float64), np.array(g, np.float64)
        if y.shape != x.shape[:1] or g.shape != x.shape:
            raise ValueError(
                f"slopes: y.shape={y.shape}, gradient.shape={g.shape}: expected {x.shape[:1]} and "
                f"{x.shape}"
            )
        bad = ~(np.isfinite(y) & np.all(np.isfinite(g), axis=1))
        self.n_gradients += len(x)
        self.n_invalid += int(bad.sum())
        y[bad], g[bad] = np.nan, np.nan
        self._seen.append((np.array(x, np.float64), y))
        return y, g

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Everything that was evaluated, in order: `(x [n, D], y [n])`."""
        return np.concatenate([x for x, _ in self._seen]), np.concatenate(
            [y for _, y in self._seen]
        )

    def differences(self, u: np.ndarray, value: float, step: float) -> np.ndarray:
        """Forward differences at one point, `[D]`, D simulations; zero where invalid."""
        moved = u[None] + step * np.eye(len(u))
        return np.nan_to_num((self(moved) - value) / step)
