"""The low-dropout regulator."""

from failure.circuits.ldo.circuit import make_ldo
from failure.circuits.ldo.regulator import solve_ldo

__all__ = ["make_ldo", "solve_ldo"]
