"""Lattice models in JAX: shape-constrained functions over plain pytrees.

Every kind of layer is a module of functions: `init(key, config)`, `apply(config, params, x)`,
`project(config, params)` and `check(config, params)`. Nothing here depends on the rest of
`fusion`. Pictures are in `fusion.lattice.plots`, which is imported on its own.
"""

from fusion.lattice import (
    categorical,
    deep_lattice,
    ensemble,
    lattice_layer,
    linear,
    pwl,
    regularizers,
)
from fusion.lattice.categorical import CategoricalConfig
from fusion.lattice.deep_lattice import DeepLatticeConfig
from fusion.lattice.ensemble import EnsembleConfig, random_features
from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.lattice_layer import vertices
from fusion.lattice.linear import LinearConfig
from fusion.lattice.optimizer import with_projection
from fusion.lattice.pwl import PWLConfig, keypoints

__all__ = [
    "CategoricalConfig",
    "DeepLatticeConfig",
    "EnsembleConfig",
    "LatticeConfig",
    "LinearConfig",
    "PWLConfig",
    "categorical",
    "deep_lattice",
    "ensemble",
    "keypoints",
    "lattice_layer",
    "linear",
    "pwl",
    "random_features",
    "regularizers",
    "vertices",
    "with_projection",
]
