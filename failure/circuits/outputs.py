"""One specification of a circuit as a performance function: larger is worse, with gradients."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from failure.circuits.protocol import CHUNK, Circuit
from failure.performances import Performance, Slopes

SMALL = 8
"""Rows of the smaller of the two programs; the other one takes `CHUNK`."""


def _blocks(x: Any, dim: int) -> tuple[int, np.ndarray]:
    """Number of rows, and the rows in blocks of one of two sizes: two programs serve all."""
    rows = np.asarray(x, np.float64)
    size = SMALL if len(rows) <= SMALL else CHUNK
    fill = -len(rows) % size
    return len(rows), np.concatenate([rows, np.repeat(rows[-1:], fill, 0)]).reshape(-1, size, dim)


def _sign(circuit: Circuit, column: int) -> float:
    return 1.0 if circuit.specs[column].sense == "max" else -1.0


def performance_of(circuit: Circuit, spec: str) -> Performance:
    """`x [n, d] -> y [n]`, larger is worse, NaN where the circuit could not be solved.

    Args:
        circuit: from `failure.circuits.get`.
        spec: name of one of its specifications.

    Raises:
        ValueError: no such specification.

    Example:
        >>> from failure import circuits
        >>> iq = performance_of(circuits.get("ldo"), "quiescent_current")
        >>> [round(1e3 * float(y), 2) for y in iq(np.zeros((1, 60)))]
        [8.14]
    """
    column = circuit.spec_index(spec)
    sign = _sign(circuit, column)

    def performance(x: Any) -> np.ndarray:
        n, blocks = _blocks(x, circuit.n_dims)
        values = []
        for block in blocks:
            specs, status = circuit.simulate(block)
            y = sign * np.asarray(specs)[:, column]
            values.append(np.where(np.asarray(status) == 0, y, np.nan))
        return np.concatenate(values)[:n]

    return performance


@lru_cache(maxsize=16)
def gradient_program(circuit: Circuit, column: int) -> Any:
    """Values, statuses and gradients of one column; samples are independent, so one sum does."""

    def total(x: Any) -> tuple[Any, Any]:
        specs, status = (circuit.short or circuit.run)(x)
        y = specs[:, column]
        return jnp.sum(jnp.where(status == 0, y, 0.0)), (y, status)

    return jax.jit(jax.value_and_grad(total, has_aux=True))


def slopes_of(circuit: Circuit, spec: str) -> Slopes:
    r"""`x [n, d] -> (y [n], dy/dx [n, d])` by the adjoint of the solver.

    Operating points by the implicit function theorem, the transient by its steps backwards, one
    linear solve with the transposed matrix each:

    .. math:: \lambda^\top J = \bar v^\top, \qquad \bar\theta = -\lambda^\top \partial_\theta F

    What all parameters cost together is measured by `scripts/benchmarks/bench_circuits.py`.
    NaN where the sample could not be solved with the steps of the first try.

    Args:
        circuit: from `failure.circuits.get`.
        spec: name of one of its specifications.

    Raises:
        ValueError: no such specification.

    Source: Director and Rohrer (1969), the adjoint network.
    """
    column = circuit.spec_index(spec)
    sign, program = _sign(circuit, column), gradient_program(circuit, column)

    def slopes(x: Any) -> tuple[np.ndarray, np.ndarray]:
        n, blocks = _blocks(x, circuit.n_dims)
        values, rows = [], []
        with jax.enable_x64(True):
            for block in blocks:
                (_, (y, status)), g = program(jnp.asarray(block))
                bad = np.asarray(status) != 0
                values.append(np.where(bad, np.nan, sign * np.asarray(y)))
                rows.append(np.where(bad[:, None], np.nan, sign * np.asarray(g)))
        return np.concatenate(values)[:n], np.concatenate(rows)[:n]

    return slopes
