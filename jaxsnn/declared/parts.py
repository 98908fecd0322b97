"""The parts of a declared network: populations of neurons, inputs, and projections between them."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxsnn._checks import require, require_whole
from jaxsnn.declared.learning_rules import Rule
from jaxsnn.declared.membranes import LIF, Neuron
from jaxsnn.declared.receptors import Delta, Receptor
from jaxsnn.declared.short_term import TsodyksMarkram


@dataclasses.dataclass(frozen=True)
class FixedProbability:
    """Each edge is there with probability `p`, drawn by `init` (another draw for each key).

    Raises:
        ValueError: `p` is no probability.
    """

    p: float

    def __post_init__(self) -> None:
        """Refuse what is no probability."""
        require(
            0.0 < self.p <= 1.0, f"p={self.p}: expected a probability above 0 and up to 1; take 0.1"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Input:
    """`n` sources whose spikes are given to `step`.

    Attributes:
        n: how many.
        sign: 1, or -1 for inhibitory ones, or one of both for each, `[n]` (Dale).

    Raises:
        ValueError: `n` is below one.
    """

    n: int
    sign: Any = 1.0

    def __post_init__(self) -> None:
        """Refuse an empty population; `declare` checks the rest."""
        require_whole("n", self.n, 1, "a population needs at least one neuron")


@dataclasses.dataclass(frozen=True, eq=False)
class Population(Input):
    """`n` neurons of one model.

    Attributes:
        n: how many.
        sign: of all that they project, see Input.
        neuron: LIF, AdaptiveLIF, Izhikevich, or a model of one's own (`membranes.Neuron`).
    """

    neuron: Neuron = dataclasses.field(default_factory=LIF)


@dataclasses.dataclass(frozen=True, eq=False)
class Projection:
    """Synapses from one population to another.

    Attributes:
        pre, post: names of the populations; an input cannot be `post`.
        weight: magnitudes, in mV, nA or uS as the receptor says: a number, a table
            `[n_pre, n_post]`, or a function `(key, shape) -> weights` that `init` calls.
        connect: "all_to_all", "one_to_one", FixedProbability, or a table of bool
            `[n_pre, n_post]`.
        delay: whole steps, at least 1: a number, one for each axon `[n_pre]`, or one for each edge
            `[n_pre, n_post]`. With 1 a spike counts for the threshold of the next step.
        receptor: Delta, Exponential or Conductance.
        rule: how the weights learn; None: they do not.
        short_term: TsodyksMarkram, or None.
        gain: factor between weight and effect.
        sign: None for the sign of `pre`, or another.
    """

    pre: str
    post: str
    weight: Any = 1.0
    connect: Any = "all_to_all"
    delay: Any = 1
    receptor: Receptor = dataclasses.field(default_factory=Delta)
    rule: Rule | None = None
    short_term: TsodyksMarkram | None = None
    gain: float = 1.0
    sign: Any = None
