"""The compiled program of a sweep: `width` trials side by side on each device, called as needed.

One executable serves every chunk and every shard, and a device's part of it always holds the same
number of trials: how trials are dealt out to calls, shards and devices cannot change their numbers.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.leaves import batch
from snn_fusion_failure.sweeps.study import Study

# (columns {leaf: [n]}, words [n, 2], seeds [n], carry) -> {metric: [n]} float64, carry leaves
Program = Callable[..., tuple[dict[str, np.ndarray], list[np.ndarray]]]


def compile_study(
    study: Study,
    *,
    root: int,
    width: int,
    common: bool = False,
    span: tuple[int, int] | None = None,
) -> Program:
    r"""Compile a study once; the result runs any list of trials.

    Seed :math:`k` of a setting whose digest is :math:`(a, b)` gets the key
    `fold_in(fold_in(fold_in(key(root), a), b), k)`: it follows from what the setting is, not from
    where it stands in a design.

    Args:
        study: what a trial is.
        root: seed of the sweep.
        width: trials side by side on one device; 1 maps, all vmaps.
        common: leave the setting out of the key, so that all settings draw the same numbers.
        span: the units of training to run, for a study that can be gone on with (`Study.carry`);
            from 0 on it starts the trials.

    Returns:
        Program. With several devices (of several processes, after `jax.distributed.initialize`)
        each takes `width` trials of a call; every process gets all numbers.

    Raises:
        ValueError: `width` is not positive.
    """
    import jax
    from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

    if width < 1:
        raise ValueError(f"chunk_size={width}: expected at least one trial side by side")
    devices = jax.devices()
    mesh = Mesh(np.asarray(devices), ("trial",), axis_types=(AxisType.Auto,))
    spread = PartitionSpec("trial")
    sharding = NamedSharding(mesh, spread)
    size = width * len(devices)

    def key_of(words: Any, seed: Any) -> Any:
        key = jax.random.key(root)
        if not common:
            key = jax.random.fold_in(jax.random.fold_in(key, words[0]), words[1])
        return jax.random.fold_in(key, seed)

    def on_device(params: Any, words: Any, seeds: Any, carry: Any) -> tuple[dict[str, Any], Any]:
        keys = jax.vmap(key_of)(words, seeds)
        if span is None:
            return study.run(params, keys), ()
        assert study.carry is not None
        if span[0] == 0:
            carry = study.carry.init(params, keys)
        carry, metrics = study.carry.advance(params, keys, carry, *span)
        return metrics, carry

    run = jax.jit(
        jax.shard_map(on_device, mesh=mesh, in_specs=spread, out_specs=spread, check_vma=False)
    )

    def scope() -> Any:
        return jax.enable_x64(True) if study.dtype == "float64" else contextlib.nullcontext()

    def to_devices(values: Any) -> Any:
        values = np.asarray(values)
        return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])

    def to_host(values: Any) -> np.ndarray:
        if jax.process_count() > 1:
            from jax.experimental import multihost_utils

            values = multihost_utils.process_allgather(values, tiled=True)
        return np.asarray(values)

    units = {leaf: study.unit_of(leaf) for leaf in study.leaves}
    trees: list[Any] = []

    def structure(params: Any, words: Any, seeds: Any) -> Any:
        """What the carry looks like as a tree; files hold its leaves."""
        if not trees:
            assert study.carry is not None
            shape = jax.eval_shape(
                lambda p, w, s: study.carry.init(p, jax.vmap(key_of)(w, s)),  # type: ignore[union-attr]
                params, words, seeds,
            )  # fmt: skip
            trees.append(jax.tree.structure(shape))
        return trees[0]

    def call(
        columns: Mapping[str, np.ndarray],
        words: np.ndarray,
        seeds: np.ndarray,
        carry: Sequence[np.ndarray] = (),
    ) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
        n = len(seeds)
        pending = []
        with scope():
            for start in range(0, n, size):
                # The last call is filled up with trials from the front, which are dropped again.
                index = np.arange(start, start + size)
                index = np.where(index < n, index, index % n)
                part = {leaf: values[index] for leaf, values in columns.items()}
                params = batch(study.params, part, size, units, study.dtype)
                inputs = jax.tree.map(
                    to_devices, (params, words[index], seeds[index].astype(np.int32))
                )
                held: Any = ()
                if carry:
                    tree = structure(*inputs)
                    leaves = [to_devices(leaf[index]) for leaf in carry]
                    held = jax.tree.unflatten(tree, leaves)
                pending.append(run(*inputs, held))
            parts = [
                ({name: to_host(out[name]) for name in study.metrics},
                 [to_host(leaf) for leaf in jax.tree.leaves(state)])
                for out, state in pending
            ]  # fmt: skip
        metrics = {
            name: np.concatenate([p[name] for p, _ in parts])[:n].astype(np.float64)
            for name in study.metrics
        }
        states = [np.concatenate(leaves)[:n] for leaves in zip(*(s for _, s in parts), strict=True)]
        return metrics, states

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
    words: np.ndarray,
    seeds: np.ndarray,
    *,
    root: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[int, float]:
    """Seconds per trial of each width, measured on trials of the sweep itself.

    Stops when a width is slower than half as fast as the best one, or when memory runs out: beyond
    it only gets worse.

    Args:
        study: what a trial is.
        columns, words, seeds: the trials to try; the widths go up to their number per device.
        root: seed of the sweep.
        clock: in seconds.
    """
    import jax

    seconds: dict[int, float] = {}
    devices = len(jax.devices())
    for width in widths_to_try(max(1, len(seeds) // devices)):
        program = compile_study(study, root=root, width=width)
        size = width * devices
        few = {leaf: values[:size] for leaf, values in columns.items()}
        try:
            program(few, words[:size], seeds[:size])  # compiles
            start = clock()
            program(few, words[:size], seeds[:size])
        except Exception:
            # No memory for more, or a trial that raises, which is a matter for its chunk.
            return seconds or {1: float("inf")}
        seconds[width] = (clock() - start) / min(size, len(seeds))
        if seconds[width] > 2.0 * min(seconds.values()):
            break
    return seconds


def out_of_memory(error: BaseException) -> bool:
    """Whether an exception of a device or the allocator says that memory ran out."""
    text = f"{type(error).__name__}: {error}"
    return isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text or (
        "out of memory" in text.lower()
    )  # fmt: skip


def fastest(seconds: Mapping[int, float], *, slack: float = 0.05) -> int:
    """The smallest width within `slack` of the best time: small ones lose less when killed.

    Example:
        >>> fastest({1: 4.0, 4: 1.02, 16: 1.0})
        4
    """
    best = min(seconds.values())
    return min(width for width, value in seconds.items() if value <= best * (1.0 + slack))
