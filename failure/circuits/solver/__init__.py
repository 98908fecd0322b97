"""The batched circuit solver: netlists, device models, modified nodal analysis, transient."""

from failure.circuits.solver.netlist import Netlist
from failure.circuits.solver.newton import Solution, dc
from failure.circuits.solver.system import System, compile_netlist
from failure.circuits.solver.transient import Grid, grid
from failure.circuits.solver.values import Values, nominal_values

__all__ = [
    "Grid",
    "Netlist",
    "Solution",
    "System",
    "Values",
    "compile_netlist",
    "dc",
    "grid",
    "nominal_values",
]
