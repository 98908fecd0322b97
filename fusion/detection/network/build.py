"""Fresh weights of a detector of any family."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.network.dense import init_dense
from fusion.detection.network.detector import init_avod


def init_detector(key: PRNGKeyArray, config: DetectorConfig) -> tuple[Any, Any]:
    """Fresh parameters and the statistics of batch norm (empty with group norm).

    Parameters are `main` and, for gated models, those that training alone needs: `auxiliary`
    (the paths of the views), `targets` (the lattice), `mean_losses` (of the paths).
    """
    return (init_dense if config.is_dense else init_avod)(key, config)


def count_main_parameters(config: DetectorConfig) -> int:
    """Parameters that inference uses, without making them."""
    shapes = jax.eval_shape(lambda: init_detector(jax.random.key(0), config)[0]["main"])
    return sum(leaf.size for leaf in jax.tree.leaves(shapes))
