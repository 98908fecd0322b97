"""Lattice models in JAX: shape-constrained functions over plain pytrees.

Every kind of layer is a module of functions: `init(key, config)`, `apply(config, params, x)`,
`project(config, params)` and `check(config, params)`. Nothing here depends on the rest of
`fusion`. The layers as flax modules are in `fusion.lattice.linen` and `fusion.lattice.nnx`.
Pictures are in `fusion.lattice.plots`, which is imported on its own; `premade`, `regularizers` and
`quantiles` have what whole models are made of.
"""

import importlib
from types import ModuleType

from fusion.lattice import (
    categorical,
    deep_lattice,
    ensemble,
    lattice_layer,
    linear,
    linen,
    pwl,
)
from fusion.lattice.categorical import CategoricalConfig
from fusion.lattice.deep_lattice import DeepLatticeConfig
from fusion.lattice.ensemble import EnsembleConfig
from fusion.lattice.estimators import LatticeClassifier, LatticeRegressor
from fusion.lattice.features import Feature
from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.linear import LinearConfig
from fusion.lattice.optimizer import with_projection
from fusion.lattice.pwl import PWLConfig
from fusion.lattice.tagged import check_tree, project_tree

__all__ = [
    "CategoricalConfig",
    "DeepLatticeConfig",
    "EnsembleConfig",
    "Feature",
    "LatticeClassifier",
    "LatticeConfig",
    "LatticeRegressor",
    "LinearConfig",
    "PWLConfig",
    "categorical",
    "check_tree",
    "deep_lattice",
    "ensemble",
    "lattice_layer",
    "linear",
    "linen",
    "nnx",
    "project_tree",
    "pwl",
    "with_projection",
]


def __getattr__(name: str) -> ModuleType:
    # flax.nnx takes a fifth of a second to import, which few programs need to pay.
    if name == "nnx":
        return importlib.import_module("fusion.lattice.nnx")
    raise AttributeError(f"module 'fusion.lattice' has no attribute {name!r}")
