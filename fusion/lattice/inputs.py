"""The one check that every layer makes on its inputs."""

from __future__ import annotations

from jax import Array

__all__ = ["require_width"]


def require_width(x: Array, width: int, layer: str) -> None:
    """Refuse inputs whose last axis is not `width`, which could broadcast to something else."""
    if x.ndim == 0 or x.shape[-1] != width:
        raise ValueError(
            f"{layer} got inputs of shape {tuple(x.shape)}; expected [..., {width}], the inputs "
            "on the last axis (x[..., None] for a single one)"
        )
