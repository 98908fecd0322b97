"""Lattice models in JAX: shape-constrained functions over plain pytrees.

Every layer is a module of functions: `init(key, config)`, `apply(params, config, x)`,
`project(params, config)` and `check(params, config)`. Nothing here depends on the rest of
`fusion`. Pictures are in `fusion.lattice.plots`, which is imported on its own.
"""

from fusion.lattice import categorical, deep_lattice, ensemble, grid, linear, pwl, regularizers
from fusion.lattice.categorical import CategoricalConfig, CategoricalParams
from fusion.lattice.deep_lattice import DeepLatticeConfig, DeepLatticeParams
from fusion.lattice.ensemble import EnsembleConfig, random_features
from fusion.lattice.grid import LatticeConfig, LatticeParams, vertices
from fusion.lattice.linear import LinearConfig, LinearParams
from fusion.lattice.optimizer import with_projection
from fusion.lattice.pwl import PWLConfig, PWLParams, keypoints

__all__ = [
    "CategoricalConfig",
    "CategoricalParams",
    "DeepLatticeConfig",
    "DeepLatticeParams",
    "EnsembleConfig",
    "LatticeConfig",
    "LatticeParams",
    "LinearConfig",
    "LinearParams",
    "PWLConfig",
    "PWLParams",
    "categorical",
    "deep_lattice",
    "ensemble",
    "grid",
    "keypoints",
    "linear",
    "pwl",
    "random_features",
    "regularizers",
    "vertices",
    "with_projection",
]
