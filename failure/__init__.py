"""Rare-failure search for analog and mixed-signal circuits.

Circuits: `circuits`, and `simulators` for your own. Search: `gp`, `gp_fit`, `acquisition`,
`embeddings`, `bayesopt`, `turbo`, `baselines`, `runs`. Learned spaces: `revnet`, `bnn`. How likely:
`rare_events`. Imported by name only, for what they bring along: `failure.rev_argate` (the fusion
package), `failure.plots` (matplotlib).
"""

from failure import (
    acquisition,
    baselines,
    bayesopt,
    bnn,
    circuits,
    embeddings,
    gp,
    gp_fit,
    optimize,
    rare_events,
    revnet,
    runs,
    sharing,
    simulators,
    thresholds,
    turbo,
)
from failure.bayesopt import SearchConfig, ask, tell
from failure.rare_events import importance_sampling, monte_carlo, subset_simulation
from failure.simulators import CommandSimulator, FunctionSimulator

__all__ = [
    "CommandSimulator",
    "FunctionSimulator",
    "SearchConfig",
    "acquisition",
    "ask",
    "baselines",
    "bayesopt",
    "bnn",
    "circuits",
    "embeddings",
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
    "subset_simulation",
    "tell",
    "thresholds",
    "turbo",
]
