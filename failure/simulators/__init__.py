"""A user's own simulator: a function, a program, or a netlist."""

from failure.simulators.processes import SimulatorError
from failure.simulators.wrappers import CommandSimulator, FunctionSimulator, Simulator

__all__ = ["CommandSimulator", "FunctionSimulator", "Simulator", "SimulatorError"]
