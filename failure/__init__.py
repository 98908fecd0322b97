"""Rare-failure search for analog and mixed-signal circuits.

Circuits: `circuits`, and `simulators` for your own. Search: `gp`, `gp_fit`, `acquisition`,
`spaces`, `bayesopt`, `turbo`, `baselines`, `runs`. Learned spaces: `revnet`, `bnn`. How likely:
`rare_events`. Imported by name only, for what they bring along: `failure.rev_argate` (the fusion
package), `failure.plots` (matplotlib).
"""

from failure import bnn, circuits, rare_events, revnet, simulators
from failure.models import acquisition, gp, gp_fit, optimize
from failure.rare_events import importance_sampling, monte_carlo, subset_simulation
from failure.search import baselines, bayesopt, runs, sharing, spaces, thresholds, turbo
from failure.search.bayesopt import SearchConfig, ask, tell
from failure.simulators.wrappers import CommandSimulator, FunctionSimulator
from failure.status import Status

__all__ = [
    "CommandSimulator",
    "FunctionSimulator",
    "SearchConfig",
    "Status",
    "acquisition",
    "ask",
    "baselines",
    "bayesopt",
    "bnn",
    "circuits",
    "gp",
    "gp_fit",
    "importance_sampling",
    "monte_carlo",
    "optimize",
    "rare_events",
    "revnet",
    "runs",
    "sharing",
    "simulators",
    "spaces",
    "subset_simulation",
    "tell",
    "thresholds",
    "turbo",
]
