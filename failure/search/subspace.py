"""Active subspaces: the directions in which the output changes most, from its gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from failure.models import gp, gp_fit
from failure.search.methods import SearchConfig
from failure.search.spaces import ActiveSubspace
from failure.search.task import unit_scale

Gradient = Callable[[Any], Any]
"""`x [n, D] -> dy/dx [n, D]`"""


def active_basis(gradients: Float[np.ndarray, "n D"], dim: int) -> np.ndarray:
    r"""Leading eigenvectors of the mean outer product of the gradients.

    .. math:: C = \frac1n \sum_i \nabla y_i \nabla y_i^\top = W \Lambda W^\top

    Rows that are not finite are left out; without any finite row the first unit vectors come back.

    Args:
        gradients: one per row.
        dim: how many directions.

    Returns:
        `[D, dim]`, orthonormal columns, strongest first; signs such that the largest entry of a
        column is positive, so that equal data give equal bases.

    Source: Constantine (2015), Equation 3.2.

    Example:
        >>> active_basis(np.array([[0.0, 2.0], [0.0, 1.0]]), 1).T.tolist()
        [[0.0, 1.0]]
    """
    rows = np.asarray(gradients, np.float64)
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    largest = np.abs(rows).max(initial=0.0)
    if largest == 0.0:
        return np.eye(np.shape(gradients)[1])[:, :dim]
    _, _, axes = np.linalg.svd(rows / largest, full_matrices=True)
    basis = axes[:dim].T
    signs = np.sign(basis[np.argmax(np.abs(basis), axis=0), np.arange(dim)])
    return basis * signs + 0.0


@lru_cache(maxsize=4)
def _slopes_of_surrogate(config: gp.GPConfig) -> Callable[..., Any]:
    """Gradient of the posterior mean of a GP in all parameters, at its own data; one program."""

    def one(args: tuple[Any, Any, Any]) -> Any:
        x, y, n = args
        start = gp_fit.initial_params(config, x.shape[1])
        found = gp_fit.fit(config, start, x, y, n, ftol=1e-6)
        posterior = gp.condition(config, found.params, x, y, n)
        return jax.vmap(jax.grad(lambda p: gp.predict(config, posterior, p[None])[0][0]))(x)

    return jax.jit(lambda x, y, n: jax.lax.map(one, (x, y, n)))


def _stack(config: SearchConfig, slopes: list[np.ndarray]) -> ActiveSubspace:
    """The spaces of all seeds from one set of gradients each."""
    assert config.embedding_dim is not None
    bases = np.stack([active_basis(rows, config.embedding_dim) for rows in slopes])
    return ActiveSubspace(
        jnp.asarray(bases), jnp.full((len(slopes),), unit_scale(config.task), bases.dtype)
    )


def train_subspace(config: SearchConfig, keys: Any, x: np.ndarray, y: np.ndarray) -> ActiveSubspace:
    """The active subspace by the gradients of a Gaussian process in all parameters.

    For a simulator without gradients: no simulation is spent, the surrogate is only as good as
    the evaluations. See `subspace_of_gradient` where there are gradients.

    Args:
        config: the search.
        keys: unused, nothing is drawn.
        x: `[S, n, D]`.
        y: `[S, n]`, NaN where invalid.

    Returns:
        One space per seed, stacked.
    """
    size = gp.padded_size(x.shape[1])
    px, py = np.zeros((len(x), size, x.shape[2])), np.zeros((len(x), size))
    counts = np.zeros(len(x), np.int32)
    for row, values in enumerate(y):
        good = np.isfinite(values)
        n = counts[row] = max(int(good.sum()), 1)
        px[row, :n] = x[row][good][:n] / unit_scale(config.task)
        spread = values[good].std(ddof=1) if n > 1 else 0.0
        if spread > 0.0:
            py[row, :n] = (values[good] - values[good].mean()) / spread
    assert config.gp is not None
    slopes = _slopes_of_surrogate(config.gp)(jnp.asarray(px), jnp.asarray(py), jnp.asarray(counts))
    slopes = np.asarray(slopes)
    return _stack(config, [rows[:n] for rows, n in zip(slopes, counts, strict=True)])


class Remembered:
    """A gradient that is evaluated once at every point.

    Args:
        gradient: `x [n, D] -> dy/dx [n, D]`.
    """

    def __init__(self, gradient: Gradient) -> None:
        self._gradient = gradient
        self._known: dict[bytes, np.ndarray] = {}

    def learn(self, x: Float[np.ndarray, "S n D"]) -> None:
        """Evaluate what is new, all of it in one call.

        Raises:
            ValueError: not a row per point.
        """
        rows = {row.tobytes(): row for block in x for row in block}
        new = [row for name, row in rows.items() if name not in self._known]
        if not new:
            return
        slopes = np.asarray(self._gradient(np.stack(new)), np.float64)
        if slopes.shape != (len(new), x.shape[2]):
            raise ValueError(
                f"gradient.shape={slopes.shape}: expected {(len(new), x.shape[2])}, a row per point"
            )
        names = [row.tobytes() for row in new]
        self._known.update(zip(names, slopes, strict=True))

    def __call__(self, x: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "n D"]:
        """Gradients of points that have been learned."""
        return np.stack([self._known[row.tobytes()] for row in x])


def subspace_of_gradient(gradient: Gradient) -> Any:
    """A `train` of `run` or `ask` that takes the simulator's own gradients.

    Each evaluation is paid once: gradients at points that have been seen are kept. Count them
    beside the simulations at the price that they have (an adjoint costs about one to three).

    Args:
        gradient: `x [n, D] -> dy/dx [n, D]`, larger y is worse.

    Returns:
        `train(config, keys, x, y) -> ActiveSubspace`.
    """
    known = Remembered(gradient)

    def train(config: SearchConfig, keys: Any, x: np.ndarray, y: np.ndarray) -> ActiveSubspace:
        known.learn(x)
        return _stack(config, [known(block) for block in x])

    return train
