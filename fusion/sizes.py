"""How many trainable values a network has, and networks of equal numbers."""

from __future__ import annotations

import dataclasses

import jax

from fusion.config import ModelConfig
from fusion.models import init


def count_parameters(config: ModelConfig) -> dict[str, int]:
    """Number of trainable values by part (`main`, `aux`, `targets`) and in `total`."""
    shapes = jax.eval_shape(lambda key: init(key, config), jax.random.key(0))
    counts = {
        part: sum(leaf.size for leaf in jax.tree.leaves(tree)) for part, tree in shapes.items()
    }
    return counts | {"total": sum(counts.values())}


def match_parameters(config: ModelConfig, reference: ModelConfig) -> ModelConfig:
    """Choose the width of the first head layer so that both have the same number of parameters.

    The counts are of all trainable values, auxiliary paths and lattice included: a model gets no
    advantage from what it carries in training.

    Raises:
        ValueError: no width brings the totals within 2 %.
    """
    if not config.head_widths:
        raise ValueError(
            "head_widths=(): expected at least one width; matching moves the first hidden layer"
        )
    wanted = count_parameters(reference)["total"]

    def at(width: int) -> ModelConfig:
        return dataclasses.replace(config, head_widths=(width, *config.head_widths[1:]))

    low, high = count_parameters(at(1))["total"], count_parameters(at(2))["total"]
    width = max(1, round(1 + (wanted - low) / (high - low)))
    matched = at(width)
    total = count_parameters(matched)["total"]
    if abs(total - wanted) > 0.02 * wanted:
        raise ValueError(
            f"head_widths={matched.head_widths}: expected {wanted} parameters within 2 %, as "
            f"{reference.model!r} has, {config.model!r} has {total}; change encoder.features or "
            "head_widths"
        )
    return matched
