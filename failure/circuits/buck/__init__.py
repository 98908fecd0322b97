"""The buck converter, at heavy and at light load."""

from failure.circuits.buck.circuit import make_dcdc, make_dcdc_light
from failure.circuits.buck.converter import solve_dcdc
from failure.circuits.buck.light_load import solve_dcdc_light

__all__ = ["make_dcdc", "make_dcdc_light", "solve_dcdc", "solve_dcdc_light"]
