"""Frames per second of each stage of the detector, and the share of the device's peak.

    python scripts/benchmarks/bench_detector.py --size small

times maps and anchors, the forward pass with both stages, suppression alone, and a training step,
for a random cloud of points. The peak is a large float32 matrix product on the same device in the
same run; the work of a stage is the count of XLA. On a CPU the time is CPU time, which a busy
machine does not change much. Minutes of compiling come first. `--record` writes
`results/bench_detector.json`. Last line: `result: ...`.

    python scripts/benchmarks/bench_detector.py --size paper --stages "training step" --repeats 1

times a single stage, here one step of the size that no CPU trains: seconds, memory, and a loss and
gradients that are finite. With one repeat the first call is the one that is timed.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.commands.detector_options import ModelOption, SizeOption
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, print_result, repository, run_command

Stage = Literal["maps and anchors", "forward", "suppression", "training step"]
STAGES: tuple[Stage, ...] = ("maps and anchors", "forward", "suppression", "training step")


@dataclasses.dataclass(frozen=True)
class Config:
    """Time the stages of the detector."""

    size: SizeOption = "small"
    model: ModelOption = "avod_argate"
    batch_size: int = 1
    repeats: int = 5
    gemm: int = 1024
    """Side of the matrices of the peak."""
    stages: tuple[Stage, ...] = STAGES
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions."""
    record: bool = False
    """Write results/bench_detector.json."""
    results: Path = repository.RESULTS


def _example(detector: Any) -> Any:
    """A frame of the preset's sizes: random points on the ground and cars at known places."""
    import numpy as np

    from fusion.detection.learning.examples import Example

    rng = np.random.RandomState(0)
    n, c = detector.max_points, detector.bev
    low = np.array([c.x_range[0], 0.0, c.z_range[0]])
    high = np.array([c.x_range[1], 1.7, c.z_range[1]])
    camera = low + (high - low) * rng.uniform(size=(n, 3))
    points = np.stack([camera[:, 2], -camera[:, 0], -camera[:, 1], np.full(n, 0.3)], axis=1)
    truth = np.zeros((detector.max_objects, 7), np.float32)
    near = rng.uniform(size=(4, 2))
    truth[:4, 0] = c.x_range[0] + (0.25 + 0.5 * near[:, 0]) * (c.x_range[1] - c.x_range[0])
    truth[:4, 2] = c.z_range[0] + (0.25 + 0.5 * near[:, 1]) * (c.z_range[1] - c.z_range[0])
    truth[:4, [1, 3, 4, 5]] = [1.7, 4.2, 1.7, 1.5]
    p2 = np.array([[721.5, 0, 610, 0], [0, 721.5, 173, 0], [0, 0, 1, 0]], np.float32)
    axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]], np.float32)
    return Example(
        rng.randint(0, 255, (*detector.image_size, 3)).astype(np.uint8),
        points.astype(np.float32), np.ones(n, bool), axes, p2,
        np.array([375.0, 1242.0], np.float32), np.array([0.0, -1, 0, 1.7], np.float32), truth,
        np.arange(detector.max_objects) < 4, np.zeros(detector.max_objects, bool),
        np.zeros((1, 4), np.float32),
    )  # fmt: skip


def _time(run: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Best of `repeats` calls [s], CPU seconds on a CPU, wall seconds on an accelerator; result."""
    import jax

    clock = time.process_time if jax.devices()[0].platform == "cpu" else time.perf_counter
    if repeats > 1:
        jax.block_until_ready(run())
    best, found = float("inf"), None
    for _ in range(max(1, repeats)):
        start = clock()
        found = jax.block_until_ready(run())
        best = min(best, clock() - start)
    return best, found


def _flops(compiled: Any) -> float:
    cost = compiled.cost_analysis()
    cost = cost[0] if isinstance(cost, list) else cost
    return float((cost or {}).get("flops", float("nan")))


def _memory(compiled: Any) -> float:
    """What a program holds at once [GB]: arguments, results and what is between."""
    found = compiled.memory_analysis()
    if found is None:
        return float("nan")
    sizes = (found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes)
    return float(sum(sizes)) / 1e9


def check_step(found: Any) -> float:
    """Loss of a training step.

    Args:
        found: what `train_step` gives.

    Raises:
        FloatingPointError: the loss or a mean of Adam, and so a gradient, is not finite.
    """
    import jax
    import jax.numpy as jnp

    state, terms, _ = found
    loss = float(terms.total)
    for path, leaf in jax.tree_util.tree_leaves_with_path((state.opt_state, state.params)):
        if not bool(jnp.isfinite(leaf).all()):
            raise FloatingPointError(f"{jax.tree_util.keystr(path)} is not finite after a step")
    if loss != loss or abs(loss) == float("inf"):
        raise FloatingPointError(f"the loss of a step is {loss}")
    return loss


def main(config: Config) -> dict[str, Any]:
    """Time every stage; returns the rows."""
    enable_compilation_cache()
    import jax
    import jax.numpy as jnp

    from fusion.detection.geometry.suppression import nms
    from fusion.detection.learning.examples import make_inputs, stack_examples
    from fusion.detection.learning.inference import detect
    from fusion.detection.learning.training import init_training, train_step
    from fusion.detection.presets import preset

    detector, training, params = preset(config.size, config.model)
    detector = dataclasses.replace(detector, precision=config.precision)
    batch = stack_examples([_example(detector)] * config.batch_size)
    batch = jax.tree.map(jnp.asarray, batch)
    key = jax.random.key(0)
    state = jax.jit(functools.partial(init_training, config=detector))(key)
    read = jax.jit(lambda b: jax.lax.map(lambda e: make_inputs(detector, e), b))
    inputs = read(batch) if "forward" in config.stages else None
    boxes = jax.random.uniform(key, (config.batch_size, detector.candidates, 2), maxval=40.0)
    boxes = jnp.concatenate([boxes, boxes + 4.0], axis=-1)
    scores = jax.random.uniform(key, boxes.shape[:2])
    keep = jax.jit(jax.vmap(lambda b, s: nms(
        b, s, jnp.ones(s.shape, bool), iou_threshold=detector.rpn_nms,
        max_output=detector.proposals_train, max_candidates=detector.candidates,
    )))  # fmt: skip
    forward = jax.jit(functools.partial(detect, detector))
    step = jax.jit(functools.partial(train_step, detector, training))
    main_params, stats = state.params["main"], state.stats
    stages: dict[str, tuple[Any, tuple[Any, ...], dict[str, Any]]] = {
        "maps and anchors": (read, (batch,), {}),
        "forward": (forward, (main_params, stats), {"inputs": inputs}),
        "suppression": (keep, (boxes, scores), {}),
        "training step": (step, (params.as_arrays(), state, batch), {"key": key}),
    }
    square = jnp.ones((config.gemm, config.gemm))
    product = jax.jit(lambda a: a @ a)
    peak = 2.0 * config.gemm**3 / _time(lambda: product(square), max(2, config.repeats))[0]
    rows = []

    def add(row: str, metric: str, unit: str, value: float) -> None:
        # Rows of `small` have been without a size since the first record.
        plain = {"small", "float32", "batch 1"}
        ends = [config.size, config.precision, f"batch {config.batch_size}"]
        name = ", ".join([row, *(end for end in ends if end not in plain)])
        cell = {"row": name, "model": config.model, "metric": metric, "unit": unit}
        rows.append(cell | summarize([value]))

    add("matrix product", "gflops", "GFLOP/s", peak / 1e9)
    for name in config.stages:
        function, arguments, named = stages[name]
        compiled = function.lower(*arguments, **named).compile()
        seconds, found = _time(functools.partial(compiled, *arguments, **named), config.repeats)
        work = _flops(compiled)
        add(name, "frames_per_second", "1/s", config.batch_size / seconds)
        add(name, "gflop_per_frame", "GFLOP", work / config.batch_size / 1e9)
        add(name, "peak_share", "%", 100.0 * work / seconds / peak)
        add(name, "memory", "GB", _memory(compiled))
        if name == "training step":
            add(name, "loss", "1", check_step(found))
        print(
            f"{name:18s} {config.batch_size / seconds:9.2f} frames/s "
            f"{work / config.batch_size / 1e9:8.2f} GFLOP/frame "
            f"{100.0 * work / seconds / peak:5.1f} % of the matrix product "
            f"{_memory(compiled):6.2f} GB",
            flush=True,
        )
    if config.record:
        title = "Throughput of the detector by stage"
        path = config.results / "bench_detector.json"
        record_table(path, "bench_detector", title, rows, preset="small, others by row")
    speed = {
        row["row"].split(",")[0].replace(" ", "_"): row["mean"]
        for row in rows
        if row["metric"] == "frames_per_second"
    }
    print_result(size=config.size, gemm_gflops=peak / 1e9, **speed)
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
