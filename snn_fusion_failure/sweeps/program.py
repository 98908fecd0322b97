"""The compiled program of a sweep: `width` trials side by side on each device, called as needed.

One executable serves every chunk and every shard, and a device's part of it always holds the same
number of trials: how trials are dealt out to calls, shards and devices cannot change their numbers.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.leaves import batch
from snn_fusion_failure.sweeps.study import Study

__all__ = ["Program", "compile_study", "fastest", "measure_widths", "widths_to_try"]

# (columns {leaf: [n]}, trial numbers [n]) -> {metric: [n]} float64
Program = Callable[[Mapping[str, np.ndarray], np.ndarray], dict[str, np.ndarray]]


def compile_study(study: Study, *, root: int, width: int) -> Program:
    r"""Compile a study once; the result runs any list of trials.

    Trial :math:`i` gets the key `fold_in(key(root), i)`.

    Args:
        study: what a trial is.
        root: seed of the sweep.
        width: trials side by side on one device; 1 maps, all vmaps.

    Returns:
        Program. With several devices (of several processes, after `jax.distributed.initialize`)
        each takes `width` trials of a call; every process gets all numbers.

    Raises:
        ValueError: `width` is not positive.
    """
    import jax
    from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

    if width < 1:
        raise ValueError(f"chunk size {width}: expected at least one trial side by side")
    devices = jax.devices()
    mesh = Mesh(np.asarray(devices), ("trial",), axis_types=(AxisType.Auto,))
    spread = PartitionSpec("trial")
    sharding = NamedSharding(mesh, spread)
    size = width * len(devices)

    def on_device(params: Any, numbers: Any) -> dict[str, Any]:
        keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(root), i))(numbers)
        return study.run(params, keys)

    run = jax.jit(
        jax.shard_map(
            on_device, mesh=mesh, in_specs=(spread, spread), out_specs=spread, check_vma=False
        )
    )

    def scope() -> Any:
        return jax.enable_x64(True) if study.dtype == "float64" else contextlib.nullcontext()

    def to_devices(values: np.ndarray) -> Any:
        return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])

    def to_host(values: Any) -> np.ndarray:
        if jax.process_count() > 1:
            from jax.experimental import multihost_utils

            values = multihost_utils.process_allgather(values, tiled=True)
        return np.asarray(values, np.float64)

    def call(columns: Mapping[str, np.ndarray], numbers: np.ndarray) -> dict[str, np.ndarray]:
        n = len(numbers)
        units = {leaf: study.unit_of(leaf) for leaf in study.leaves}
        pending = []
        with scope():
            for start in range(0, n, size):
                # The last call is filled up with trials from the front, which are dropped again.
                index = np.arange(start, start + size)
                index = np.where(index < n, index, index % n)
                part = {leaf: values[index] for leaf, values in columns.items()}
                params = batch(study.params, part, size, units, study.dtype)
                inputs = jax.tree.map(to_devices, (params, numbers[index].astype(np.int32)))
                pending.append(run(*inputs))
            parts = [{name: to_host(out[name]) for name in study.metrics} for out in pending]
        return {name: np.concatenate([p[name] for p in parts])[:n] for name in study.metrics}

    return call


def widths_to_try(most: int) -> list[int]:
    """1, 4, 16 ... up to `most`, which is the last.

    Example:
        >>> widths_to_try(20), widths_to_try(1)
        ([1, 4, 16, 20], [1])
    """
    widths = [1]
    while widths[-1] * 4 < most:
        widths.append(widths[-1] * 4)
    return widths if widths[-1] == most else [*widths, most]


def measure_widths(
    study: Study,
    columns: Mapping[str, np.ndarray],
    numbers: np.ndarray,
    *,
    root: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[int, float]:
    """Seconds per trial of each width, measured on trials of the sweep itself.

    Stops when a width is slower than half as fast as the best one: beyond it only gets worse.

    Args:
        study: what a trial is.
        columns, numbers: the trials to try; the widths go up to their number per device.
        root: seed of the sweep.
        clock: in seconds.
    """
    import jax

    seconds: dict[int, float] = {}
    devices = len(jax.devices())
    for width in widths_to_try(max(1, len(numbers) // devices)):
        program = compile_study(study, root=root, width=width)
        size = width * devices
        few = {leaf: values[:size] for leaf, values in columns.items()}
        program(few, numbers[:size])  # compiles
        start = clock()
        program(few, numbers[:size])
        seconds[width] = (clock() - start) / min(size, len(numbers))
        if seconds[width] > 2.0 * min(seconds.values()):
            break
    return seconds


def fastest(seconds: Mapping[int, float], *, slack: float = 0.05) -> int:
    """The smallest width within `slack` of the best time: small ones lose less when killed.

    Example:
        >>> fastest({1: 4.0, 4: 1.02, 16: 1.0})
        4
    """
    best = min(seconds.values())
    return min(width for width, value in seconds.items() if value <= best * (1.0 + slack))
