"""Rare-failure search for analog and mixed-signal circuits.

What is listed here is kept stable; the rest of the package may change.

- Simulators: `circuits.get(name)`, `CommandSimulator`, `FunctionSimulator`, `Status`.
- Search: `Task`, `SearchConfig`, `run_search`, `start_from`, `side_by_side`, or `init_search`,
  `ask` and `tell` by hand; `GPConfig`, `AcquisitionConfig`; `first_hit`, `best_so_far`.
- How likely: `design_points`, `importance_sampling`, `subset_simulation`, `monte_carlo`.

Imported by name only, for what they bring along: `failure.rev_argate` (the fusion package),
`failure.plots` (matplotlib).
"""

from failure import circuits
from failure.form import design_points
from failure.models.acquisition import AcquisitionConfig
from failure.models.kernels import GPConfig
from failure.rare_events import Estimate, importance_sampling, monte_carlo, subset_simulation
from failure.search.bayesopt import ask, tell
from failure.search.bayesopt import init as init_search
from failure.search.history import best_so_far, first_hit
from failure.search.methods import SearchConfig
from failure.search.runs import run as run_search
from failure.search.runs import start_from
from failure.search.sharing import side_by_side
from failure.search.task import Task
from failure.simulators.wrappers import CommandSimulator, FunctionSimulator
from failure.status import Status

__all__ = [
    "AcquisitionConfig",
    "CommandSimulator",
    "Estimate",
    "FunctionSimulator",
    "GPConfig",
    "SearchConfig",
    "Status",
    "Task",
    "ask",
    "best_so_far",
    "circuits",
    "design_points",
    "first_hit",
    "importance_sampling",
    "init_search",
    "monte_carlo",
    "run_search",
    "side_by_side",
    "start_from",
    "subset_simulation",
    "tell",
]
