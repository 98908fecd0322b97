"""Spiking networks from a list of populations and projections, as pure functions.

`declare` checks what it is given and makes a `Wiring`; `init`, `step` and `run` work with it and
can be jitted, vmapped and scanned; `window` and `reinforce` take many steps at once with the
weights held. `docs/snn_fidelity.md` compares each model with Brian 2.

- Parts: `Input`, `Population`, `Projection`, `FixedProbability`.
- Neurons: `LIF`, `AdaptiveLIF`, `Izhikevich`. Receptors: `Delta`, `Exponential`, `Conductance`.
- Plasticity: `PairSTDP`, `TripletSTDP`, `RewardSTDP`; short-term: `TsodyksMarkram`.
"""

from jaxsnn.declared.learning_rules import PairSTDP, RewardSTDP, TripletSTDP
from jaxsnn.declared.membranes import LIF, AdaptiveLIF, Izhikevich
from jaxsnn.declared.parts import FixedProbability, Input, Population, Projection
from jaxsnn.declared.receptors import Conductance, Delta, Exponential
from jaxsnn.declared.short_term import TsodyksMarkram
from jaxsnn.declared.stepping import Params, State, constants, init, run, step
from jaxsnn.declared.windowed import reinforce, window, window_kernels
from jaxsnn.declared.wiring import Wiring, declare

__all__ = [
    "LIF",
    "AdaptiveLIF",
    "Conductance",
    "Delta",
    "Exponential",
    "FixedProbability",
    "Input",
    "Izhikevich",
    "PairSTDP",
    "Params",
    "Population",
    "Projection",
    "RewardSTDP",
    "State",
    "TripletSTDP",
    "TsodyksMarkram",
    "Wiring",
    "constants",
    "declare",
    "init",
    "reinforce",
    "run",
    "step",
    "window",
    "window_kernels",
]
