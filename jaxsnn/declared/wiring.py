"""`declare`: from parts to a network that has been checked and is ready to be run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_choice,
    require_finite,
    require_positive,
)
from jaxsnn.declared.parts import FixedProbability, Input, Population, Projection
from jaxsnn.declared.receptors import Conductance
from jaxsnn.plasticity import check_bounds


@dataclasses.dataclass(frozen=True)
class Edges:
    """What never changes about a projection: who sits at its ends, sign, delay, fixed table.

    Attributes:
        shape: `(n_pre, n_post)`.
        sign: 1 or -1 for each presynaptic neuron, `[n_pre]`.
        delay: steps, a scalar, `[n_pre]` or `[n_pre, n_post]`.
        table: which edges are there, `[n_pre, n_post]`; None for all, or where `init` draws them.
    """

    shape: tuple[int, int]
    sign: np.ndarray
    delay: np.ndarray
    table: np.ndarray | None

    @property
    def arriving(self) -> tuple[int, int]:
        """Shape of the arriving spikes: a column unless each edge has a delay of its own."""
        return self.shape if self.delay.ndim == 2 else (self.shape[0], 1)


@dataclasses.dataclass(frozen=True, eq=False)
class Wiring:
    """A checked network; hashed by identity, so it can be a static argument of `jax.jit`.

    Attributes:
        dt: step [s].
        populations, projections: the parts by name.
        edges: what was made of each projection.
        depth: steps of spikes that each population has to remember; 1 where no delay needs it.
    """

    dt: float
    populations: Mapping[str, Input]
    projections: Mapping[str, Projection]
    edges: Mapping[str, Edges]
    depth: Mapping[str, int]

    def names(self, kind: type) -> list[str]:
        """Names of the inputs (`Input`) or of the neurons (`Population`), in order."""
        return [name for name, part in self.populations.items() if type(part) is kind]


def declare(
    populations: Mapping[str, Input], projections: Mapping[str, Projection], *, dt: float = 1e-3
) -> Wiring:
    """Check the parts of a network and put them together.

    Args:
        populations: Input and Population by name.
        projections: Projection by name; no name twice, not even one of a population.
        dt: step [s].

    Returns:
        Wiring, for `init`, `step` and `run`.

    Raises:
        ValueError: an unknown population, a table of the wrong shape, a delay below one step or
            not whole, weights that are not finite or out of bounds, a sign that is neither 1 nor
            -1, constants that a step of `dt` cannot follow.

    Example:
        >>> net = declare({"in": Input(3), "out": Population(2)},
        ...               {"drive": Projection("in", "out", weight=20.0)})
        >>> net.edges["drive"].shape
        (3, 2)
    """
    require_positive("dt", dt, "give the step in seconds, 1e-3 for one millisecond")
    twice = sorted(set(populations) & set(projections))
    require(
        not twice,
        f"projections={twice}: expected names that no population has; inputs go by name, rename it",
    )
    require(
        any(isinstance(part, Population) for part in populations.values()),
        f"populations={sorted(populations)}: expected at least one Population; inputs alone do not "
        "compute",
    )
    for name, part in populations.items():
        _sign(f"populations[{name!r}].sign", part.sign, part.n)
        if isinstance(part, Population):
            part.neuron.check(dt)
    edges = {name: _edges(name, part, populations) for name, part in projections.items()}
    depth = dict.fromkeys(populations, 1)
    for name, synapses in projections.items():
        depth[synapses.pre] = max(depth[synapses.pre], int(edges[name].delay.max()))
    return Wiring(dt, dict(populations), dict(projections), edges, depth)


def _edges(name: str, part: Projection, populations: Mapping[str, Input]) -> Edges:
    """Check one projection; every message starts with its name."""
    where = f"projections[{name!r}]"
    require_choice(f"{where}.pre", part.pre, tuple(populations))
    require_choice(f"{where}.post", part.post, tuple(populations))
    pre, post = populations[part.pre], populations[part.post]
    require(
        isinstance(post, Population),
        f"{where}.post={part.post!r}: expected a Population; an Input receives nothing",
    )
    shape = (pre.n, post.n)
    part.receptor.check()
    for extra in (part.rule, part.short_term):
        if extra is not None:
            extra.check()
    require_finite(f"{where}.gain", part.gain, "take 1.0")
    sign = _sign(f"{where}.sign", pre.sign if part.sign is None else part.sign, pre.n)
    require(
        not isinstance(part.receptor, Conductance) or bool((sign > 0).all()),
        f"{where}.sign={sign.min():g}: expected 1 with a conductance; its reversal potential makes "
        "it inhibitory, say sign=1",
    )
    table = _table(f"{where}.connect", part.connect, shape)
    _check_weight(f"{where}.weight", part, shape, table)
    return Edges(shape, sign, _delay(f"{where}.delay", part.delay, shape), table)


def _sign(name: str, value: Any, n: int) -> np.ndarray:
    given = np.asarray(value, float)
    require(
        given.shape in ((), (n,)),
        f"{name}=<shape {given.shape}>: expected a number or one for each of the {n} neurons; "
        "repeat it",
    )
    require(
        bool(np.isin(given, (-1.0, 1.0)).all()),
        f"{name}={given.flat[np.abs(np.abs(given) - 1).argmax()]:g}: expected 1 or -1; sizes "
        "belong to weight or gain",
    )
    return np.broadcast_to(given, (n,))


def _delay(name: str, value: Any, shape: tuple[int, int]) -> np.ndarray:
    given = np.asarray(value)
    allowed = ((), shape[:1], shape)
    require(
        given.shape in allowed,
        f"{name}=<shape {given.shape}>: expected a number, one for each of the {shape[0]} axons, "
        f"or a table {shape}; mind that rows are presynaptic",
    )
    require(
        given.dtype.kind in "iu",
        f"{name}=<{given.dtype}>: expected whole steps; divide by dt, round, and make it int",
    )
    require(
        bool((given >= 1).all()),
        f"{name}={given.min()}: expected at least 1 step; with 1 a spike counts in the next step",
    )
    return given


def _table(name: str, value: Any, shape: tuple[int, int]) -> np.ndarray | None:
    if isinstance(value, FixedProbability):
        return None
    if isinstance(value, str):
        require_choice(name, value, ("all_to_all", "one_to_one"))
        if value == "all_to_all":
            return None
        require(
            shape[0] == shape[1],
            f"{name}='one_to_one': expected populations of one size, not {shape}; give a table",
        )
        return np.eye(shape[0], dtype=bool)
    given = np.asarray(value)
    require(
        given.shape == shape,
        f"{name}=<shape {given.shape}>: expected a table (n_pre, n_post) = {shape}; transpose it "
        "or take 'all_to_all'",
    )
    require(
        given.dtype == bool,
        f"{name}=<{given.dtype}>: expected a table of bool; write table > 0, and sizes as weight",
    )
    return given


def _check_weight(
    name: str, part: Projection, shape: tuple[int, int], table: np.ndarray | None
) -> None:
    if callable(part.weight):
        return
    given = concrete(part.weight)
    if given is None:
        return
    require(
        given.shape in ((), shape),
        f"{name}=<shape {given.shape}>: expected a number or a table (n_pre, n_post) = {shape}; "
        "transpose it",
    )
    require_finite(name, given, "start from weights that have been computed well")
    used = np.broadcast_to(given, shape)
    used = used if table is None else used[table]
    if isinstance(part.receptor, Conductance):
        require_positive(name, used, "a conductance is not negative", zero=True)
    if part.rule is not None and used.size:
        check_bounds(jnp.asarray(used, default_float()), part.rule.w_min, part.rule.w_max, name)
