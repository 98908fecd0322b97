"""What a circuit offers to a search: dimensions, box, specifications, one function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.status import Status

CHUNK = 64
"""Samples that are solved side by side; a batch this wide keeps the solver in the cache."""


Solve = Callable[[Float[Array, "d b"]], tuple[Float[Array, "m b"], Int[Array, "b"]]]
"""Batch last: `[d, b] -> (specs [m, b], status [b])`."""


class Spec(NamedTuple):
    """One specification; a sample fails when the value is above (sense "max") its threshold."""

    name: str
    unit: str
    sense: str
    description: str


@dataclass(frozen=True, eq=False)
class Circuit:
    """A circuit under parameter variation.

    `simulate(x)` maps `x [n, d]`, in units of sigma, to `(specs [n, m] float64, status [n] int)`;
    status is a `failure.Status`; anything but 0 is neither a pass nor a failure. It computes in
    float64 whatever the caller's setting, and may be jitted, mapped and differentiated inside
    `jax.enable_x64(True)`.
    """

    name: str
    parameter_names: tuple[tuple[str, str], ...]
    """(transistor, quantity) of every dimension."""
    sigma: tuple[float, ...]
    """One sigma of every dimension, relative or in volts, as `parameter_units` says."""
    parameter_units: tuple[str, ...]
    specs: tuple[Spec, ...]
    run: Callable[[Array], tuple[Array, Array]] = field(repr=False)
    """The pure function behind `simulate`; call it with float64 inside `jax.enable_x64(True)`."""
    reference: Callable[..., tuple[np.ndarray, np.ndarray]] = field(repr=False)
    """The same samples by ngspice: `reference(x, **options) -> (specs, status)`."""
    box: float = 3.0
    again: Callable[[Array], tuple[Array, Array]] | None = field(default=None, repr=False)
    """A slower `run` for samples that the first could not solve; compiled when it is needed."""
    short: Callable[[Array], tuple[Array, Array]] | None = field(default=None, repr=False)
    """`run` as a program that is quicker to compile, for gradients."""
    _jit: Any = field(init=False, repr=False)
    _jit_again: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_jit", jax.jit(self.run))
        object.__setattr__(self, "_jit_again", jax.jit(self.again) if self.again else None)

    @property
    def n_dims(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (lo, hi) of the parameter box in sigma."""
        hi = np.full(self.n_dims, self.box)
        return -hi, hi

    @cached_property
    def nominal(self) -> np.ndarray:
        """Specifications at x = 0, `[m]`."""
        specs, _ = self.simulate(np.zeros((1, self.n_dims)))
        return np.asarray(specs)[0]

    @property
    def spec_names(self) -> tuple[str, ...]:
        """Names of the specifications, in the order of the columns."""
        return tuple(s.name for s in self.specs)

    def spec_index(self, name: str) -> int:
        """Column of a specification.

        Raises:
            ValueError: no such specification.
        """
        if name not in self.spec_names:
            raise ValueError(
                f"spec={name!r}: expected a specification of {self.name!r}, one of "
                f"{', '.join(map(repr, self.spec_names))}"
            )
        return self.spec_names.index(name)

    def simulate(self, x: Float[Any, "n d"]) -> tuple[Float[Array, "n m"], Int[Array, "n"]]:
        """Specifications and status of a batch of samples.

        Args:
            x: parameters in sigma.
        Returns:
            (specs `[n, m]` float64, status `[n]`).
        Raises:
            ValueError: wrong shape.
        """
        if x.ndim != 2 or x.shape[1] != self.n_dims:
            raise ValueError(
                f"x of shape {tuple(x.shape)}: expected [n, {self.n_dims}], one row per sample of "
                f"{self.name!r}"
            )
        with jax.enable_x64(True):
            specs, status = self._jit(jnp.asarray(x, jnp.float64))
            if self.again is None or isinstance(status, jax.core.Tracer):
                return specs, status
            rows = np.flatnonzero(np.asarray(status) != Status.GOOD)
            if rows.size == 0:
                return specs, status
            # A whole chunk, so that any number of them takes one program.
            padded = np.resize(rows, -(-rows.size // CHUNK) * CHUNK)
            new, new_status = self._jit_again(jnp.asarray(np.asarray(x)[padded], jnp.float64))
            specs = specs.at[rows].set(new[: rows.size])
            return specs, status.at[rows].set(new_status[: rows.size])


def varied_circuit(
    name: str,
    model: str,
    transistors: Sequence[str],
    quantities: Sequence[tuple[str, str, float]],
    specs: tuple[Spec, ...],
    solve: Solve,
    *,
    reference: Callable[..., tuple[np.ndarray, np.ndarray]],
    again: Solve | None = None,
    short: Solve | None = None,
) -> Circuit:
    """A circuit in which the same quantities of every transistor vary, transistor-major.

    Args:
        name: of the circuit; "_level1" is added where the model is not "ekv".
        model: MOSFET model.
        transistors: names.
        quantities: (name, unit of sigma, sigma) of what varies in each.
        specs: what is measured.
        solve: batch last, `[d, b] -> (specs [m, b], status [b])`.
        reference: the same samples by ngspice.
        again: a slower `solve` for samples that the first could not solve.
        short: `solve` as a program that is quicker to compile, for gradients.
    """
    return Circuit(
        name=name if model == "ekv" else f"{name}_{model}",
        parameter_names=tuple((t, q) for t in transistors for q, _, _ in quantities),
        sigma=tuple(s for _ in transistors for _, _, s in quantities),
        parameter_units=tuple(u for _ in transistors for _, u, _ in quantities),
        specs=specs,
        run=lambda x: in_chunks(solve, x),
        reference=reference,
        again=None if again is None else lambda x: in_chunks(again, x),
        short=None if short is None else lambda x: in_chunks(short, x),
    )


def in_chunks(
    solve: Solve,
    x: Float[Array, "n d"],
    *,
    chunk: int = CHUNK,
) -> tuple[Float[Array, "n m"], Int[Array, "n"]]:
    """Run a batch-last solver over `x [n, d]` in chunks of one size.

    Args:
        solve: `[d, b] -> (specs [m, b], status [b])`.
        x: samples.
        chunk: batch of one chunk; the last is filled with copies of the last sample.
    Returns:
        (specs `[n, m]`, status `[n]`).
    """
    n, d = x.shape
    chunk = min(chunk, n)
    count = -(-n // chunk)
    padded = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (count * chunk - n, d))])
    blocks = padded.reshape(count, chunk, d).transpose(0, 2, 1)
    if count == 1:
        # A loop of one turn would carry everything that a gradient needs through it.
        one, good = solve(blocks[0])
        return one.T[:n], good[:n]
    specs, status = jax.lax.map(solve, blocks)
    return (
        specs.transpose(0, 2, 1).reshape(count * chunk, -1)[:n],
        status.reshape(count * chunk)[:n],
    )
