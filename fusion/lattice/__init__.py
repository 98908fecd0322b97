"""Lattice models in JAX: shape-constrained functions over plain pytrees.

Each module has `init(key, config)`, `apply(params, config, x)`, `project(params, config)` and
`check(params, config)`. Nothing here depends on the rest of `fusion`.
"""

from fusion.lattice import deep_lattice, grid, linear, pwl
from fusion.lattice.deep_lattice import DeepLatticeConfig, DeepLatticeParams
from fusion.lattice.grid import LatticeConfig, LatticeParams
from fusion.lattice.linear import LinearConfig, LinearParams
from fusion.lattice.pwl import PWLConfig, PWLParams

__all__ = [
    "DeepLatticeConfig",
    "DeepLatticeParams",
    "LatticeConfig",
    "LatticeParams",
    "LinearConfig",
    "LinearParams",
    "PWLConfig",
    "PWLParams",
    "deep_lattice",
    "grid",
    "linear",
    "pwl",
]
