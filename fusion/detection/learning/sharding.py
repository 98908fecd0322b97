r"""One training step on several local devices, each with its share of the frames.

.. math:: g = \frac{1}{B} \sum_{d=1}^{D} \sum_{i \in S_d} \nabla L_i, \qquad |S_d| = B / D

Parameters and optimizer are the same on every device; frames and what is computed from them lie
where their share is. The compiler sums gradients, and the statistics of batch norm, over all
devices, so that a step is that of the whole batch on one device up to the order of its sums.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_FRAMES = "frames"


def frame_mesh(devices: int, batch_size: int) -> Mesh | None:
    """The first local devices in a row, to share the frames of a step; None for a single one.

    Args:
        devices: how many.
        batch_size: frames of a step.

    Raises:
        ValueError: there are not so many devices, or the frames do not divide by them.

    Example:
        >>> frame_mesh(1, 3) is None
        True
        >>> frame_mesh(2, 3)
        Traceback (most recent call last):
        ValueError: batch_size=3: expected a multiple of devices=2; take batch_size=4 or 1 device
    """
    if devices < 1:
        raise ValueError(f"devices={devices}: expected at least 1; leave it out for one")
    if batch_size % devices:
        more = batch_size + -batch_size % devices
        raise ValueError(
            f"batch_size={batch_size}: expected a multiple of devices={devices}; take "
            f"batch_size={more} or 1 device"
        )
    if devices == 1:
        return None
    found = jax.local_devices()
    if devices > len(found):
        raise ValueError(
            f"devices={devices}: expected at most {len(found)}, the local devices of platform "
            f"{found[0].platform!r}; take {len(found)}"
        )
    return Mesh(np.array(found[:devices]), (_FRAMES,))


def on_all(mesh: Mesh | None, tree: Any) -> Any:
    """Arrays of which every device holds all."""
    return tree if mesh is None else jax.device_put(tree, whole(mesh))


def in_shares(mesh: Mesh | None, frames: Any) -> Any:
    """Arrays with a leading axis of frames, of which every device holds its share."""
    if mesh is None:
        return frames
    return jax.device_put(frames, NamedSharding(mesh, PartitionSpec(_FRAMES)))


def whole(mesh: Mesh) -> NamedSharding:
    """Where arrays lie that all devices hold."""
    return NamedSharding(mesh, PartitionSpec())


def map_frames(one: Callable[[Any], Any], frames: Any, mesh: Mesh | None) -> Any:
    """`jax.lax.map` over frames, inside jit; every device goes through its own."""
    run = functools.partial(jax.lax.map, one)
    if mesh is None:
        return run(frames)
    share = PartitionSpec(_FRAMES)
    return jax.shard_map(run, mesh=mesh, in_specs=share, out_specs=share, check_vma=False)(frames)
