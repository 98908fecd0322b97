"""What every function of arrays must stand: jit without a second trace, vmap = scan, finite grad.

A table of cases per package (`tests/*/test_api_*.py`) says how to call each function; `check` puts
all uses of a function into one program, since compiling is what such a test costs.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

BATCH = 3


@dataclasses.dataclass(frozen=True)
class Case:
    """How to call one public function.

    Attributes:
        name: `module.function`, with a remark in brackets where a function has several cases.
        function: takes arrays or trees of arrays only; what is static is bound already.
        make: arguments for a random generator.
        grad: arguments in which the sum of the results is differentiated; their leaves are floats.
        why: why there is no gradient, where `grad` is empty.
        misses: infinite results are allowed (a ray that meets nothing).
    """

    name: str
    function: Callable[..., Any]
    make: Callable[[np.random.Generator], tuple]
    grad: tuple[int, ...] = (0,)
    why: str = ""
    misses: bool = False

    @property
    def public_name(self) -> str:
        """The name without the remark."""
        return self.name.split(" ")[0]


def floats(tree: Any) -> list[jax.Array]:
    """The leaves of a tree that are floating point numbers."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree) if not _is_key(leaf)]
    return [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)]


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _words(tree: Any) -> Any:
    """The same tree with keys as words, which can be compared."""
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)


def batch_of(case: Case, seed: int) -> tuple:
    """Arguments of `BATCH` calls, stacked."""
    rng = np.random.default_rng(seed)
    calls = [case.make(rng) for _ in range(BATCH)]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *calls)


def program_of(case: Case) -> Callable[[tuple], tuple[Any, Any, Any]]:
    """One function that scans, vmaps and differentiates the case's function."""

    def total(*arguments: Any) -> jax.Array:
        parts = [
            jnp.sum(jnp.where(jnp.isfinite(leaf), leaf, jnp.zeros_like(leaf)))
            for leaf in floats(case.function(*arguments))
        ]
        return jnp.sum(jnp.stack(parts))

    def program(batch: tuple) -> tuple[Any, Any, Any]:
        def one(carry: None, arguments: tuple) -> tuple[None, Any]:
            return carry, case.function(*arguments)

        _, scanned = jax.lax.scan(one, None, batch)
        slopes = jax.vmap(jax.grad(total, case.grad))(*batch) if case.grad else ()
        return _words(scanned), _words(jax.vmap(case.function)(*batch)), slopes

    return program


def check(case: Case, *, x64: bool = False, rtol: float = 2e-5, atol: float = 2e-5) -> None:
    """Trace once for two batches of equal shape; vmap = scan; nothing is NaN; slopes are finite."""
    assert bool(case.grad) != bool(case.why), "say why a function has no gradient"
    with jax.enable_x64(True) if x64 else contextlib.nullcontext():
        # chex counts by name, and the program of every case has the same one.
        chex.clear_trace_counter()
        program = jax.jit(chex.assert_max_traces(program_of(case), n=1))
        moved = False
        for seed in (0, 1):
            batch = batch_of(case, seed)
            scanned, mapped, slopes = jax.tree.map(np.asarray, program(batch))
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), scanned, mapped
            )
            for leaf in floats(scanned):
                assert not np.isnan(leaf).any(), "a result is NaN"
                assert case.misses or np.isfinite(leaf).all(), "a result is infinite"
            for leaf in floats(slopes):
                assert np.isfinite(leaf).all(), "a slope is not finite"
                moved = moved or bool(np.any(leaf != 0))
        assert moved or not case.grad, "all slopes are zero: nothing is differentiated"


def functions_named(cases: Iterable[Case]) -> set[str]:
    """The public names that a table covers."""
    return {case.public_name for case in cases}
