"""The host loops around training and detection: order of frames, checkpoints, resume, reports.

Step i draws its frames and keys from the run's seed and i alone, so a resumed run goes on with the
same bits, and both models of one seed see the same frames with the same failures.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.checkpoints import Checkpoints
from fusion.detection.learning.clean_readings import with_clean_readings
from fusion.detection.learning.dense_objective import dense_detect
from fusion.detection.learning.examples import Example, make_inputs, stack_examples
from fusion.detection.learning.inference import detect
from fusion.detection.learning.interrupts import interrupt_between_steps
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.sharding import frame_mesh, in_shares, on_all, whole
from fusion.detection.learning.training import (
    DetectorState,
    DetectorTrainConfig,
    fail_sensor,
    init_training,
    train_step,
)
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import Detections
from fusion.detection.sensors.platt import AS_TOLD, Calibration
from fusion.loop import TrainingDiverged


class DetectorFit(NamedTuple):
    """The trained state and a row of means every `report_every` steps."""

    state: DetectorState
    history: list[dict[str, float]]


def restore_detector(config: DetectorConfig, folder: Path) -> DetectorState | None:
    """The newest state of a folder of checkpoints; None when there is none."""
    if not folder.is_dir():
        return None
    checkpoints = Checkpoints(folder)
    held = checkpoints.restore(_init(config)(jax.random.key(0)))
    checkpoints.close()
    return None if held is None else held[1]


# One compiled program per network serves all seeds, rates and failures of a study.
@functools.lru_cache(maxsize=8)
def _step(
    config: DetectorConfig, train: DetectorTrainConfig, mesh: Mesh | None = None
) -> Callable[..., Any]:
    step = functools.partial(train_step, config, train, mesh=mesh)
    if mesh is None:
        return jax.jit(step, donate_argnames="state")
    return jax.jit(step, donate_argnames="state", out_shardings=whole(mesh))


@functools.lru_cache(maxsize=8)
def _init(config: DetectorConfig) -> Callable[..., DetectorState]:
    # Inside jit the forward pass that flax runs to learn the shapes is dead code and costs nothing.
    return jax.jit(functools.partial(init_training, config=config))


def frame_order(seed: int, n_frames: int, step: int, batch_size: int) -> np.ndarray:
    """Frames of a step: every frame once before any comes again, in an order drawn anew."""
    index = np.arange(step * batch_size, (step + 1) * batch_size)
    orders: dict[int, np.ndarray] = {}
    for epoch in set((index // n_frames).tolist()):
        orders[epoch] = np.random.RandomState([seed, epoch]).permutation(n_frames)
    return np.array([orders[i // n_frames][i % n_frames] for i in index.tolist()])


def _means(rows: Sequence[tuple[Any, Any]]) -> dict[str, float]:
    terms = [row[0] for row in rows]
    out = {
        name: float(np.mean([np.mean(np.asarray(getattr(t, name))) for t in terms]))
        for name in terms[0]._fields
        if name != "weights"
    }
    weights = np.concatenate([np.asarray(t.weights) for t in terms])
    failed = np.concatenate([np.asarray(row[1]) for row in rows])
    out["weight_camera"] = float(weights[:, 0].mean())
    for k, sensor in enumerate(("camera", "lidar")):
        if failed[:, k].any():
            out[f"weight_failed_{sensor}"] = float(weights[failed[:, k], k].mean())
    return out


def fit_detector(
    config: DetectorConfig,
    train: DetectorTrainConfig,
    params: DetectorParams,
    n_frames: int,
    read: Callable[[int], Example],
    *,
    seed: int = 0,
    report_every: int = 20,
    on_report: Callable[[int, dict[str, float]], None] | None = None,
    checkpoint_dir: Path | None = None,
    checkpoint_every: int = 500,
    resume: bool = False,
    devices: int = 1,
) -> DetectorFit:
    """Train a detector.

    Args:
        config, train: static.
        params: rates and weights; other numbers run the same compiled step.
        n_frames, read: number of training frames, and the example of frame i; called in a thread
            one step ahead.
        seed: of weights, order of frames, failures, mini-batches.
        report_every: steps between reports; on_report: called with (steps done, means).
        checkpoint_dir, checkpoint_every: where to keep checkpoints, steps between them; the last
            step and an interrupt save too.
        resume: go on from the newest checkpoint.
        devices: local devices that share the frames of a step; a resumed training may have others.

    Returns:
        The state after the last step and the reported means.

    Raises:
        ValueError: checkpoints are there and `resume` is not set, there are no frames, or those of
            a step do not divide by the devices.
        TrainingDiverged: the loss is not finite; the checkpoint before it is kept.
    """
    if n_frames < 1:
        raise ValueError(f"n_frames={n_frames}: expected at least one training frame")
    mesh = frame_mesh(devices, train.batch_size)
    key = jax.random.key(seed)
    state = _init(config)(jax.random.fold_in(key, 0))
    start = 0
    history: list[dict[str, float]] = []
    checkpoints = None if checkpoint_dir is None else Checkpoints(checkpoint_dir)
    if checkpoints is not None and (held := checkpoints.restore(state)) is not None:
        if not resume:
            raise ValueError(
                f"{checkpoint_dir} holds checkpoints of another run; resume it, or choose an "
                "empty folder"
            )
        start, state, history = held
    else:
        clean_key = jax.random.fold_in(key, 2)
        state = with_clean_readings(config, train, state, n_frames, read, key=clean_key)
    advance, rates = _step(config, train, mesh), params.as_arrays()
    state = on_all(mesh, state)
    step_key = jax.random.fold_in(key, 1)

    def batch(step: int) -> Example:
        order = frame_order(seed, n_frames, step, train.batch_size)
        frames: Example = in_shares(mesh, stack_examples([read(i) for i in order.tolist()]))
        return frames

    done, rows = start, []
    with ThreadPoolExecutor(1) as reader, interrupt_between_steps() as check:
        ahead = reader.submit(batch, start) if start < train.steps else None
        try:
            for step in range(start, train.steps):
                assert ahead is not None
                examples = ahead.result()
                ahead = reader.submit(batch, step + 1) if step + 1 < train.steps else None
                state, terms, failed = advance(
                    rates, state=state, batch=examples, key=jax.random.fold_in(step_key, step)
                )
                rows.append((terms, failed))
                done = step + 1
                check()
                if done % report_every and done < train.steps:
                    continue
                row = {"step": float(done), **_means(rows)}
                rows = []
                if not np.isfinite(row["total"]):
                    raise TrainingDiverged(
                        f"the loss is {row['total']} near step {done}; lower the learning rate "
                        f"({float(params.learning_rate):g})"
                    )
                history.append(row)
                if on_report is not None:
                    on_report(done, row)
                if checkpoints is not None and done % checkpoint_every < report_every:
                    checkpoints.save(done, state, history)
        except KeyboardInterrupt:
            if checkpoints is not None:
                checkpoints.save(done, state, history)
                checkpoints.close()
            raise
    if checkpoints is not None:
        checkpoints.save(done, state, history)
        checkpoints.close()
    return DetectorFit(state, history)


@functools.lru_cache(maxsize=32)
def _inputs(config: DetectorConfig, failure: str | None) -> Callable[..., Inputs]:
    def run(key: Any, example: Example, severity: Any) -> Inputs:
        if failure is None:
            inputs = make_inputs(config, example)
        else:
            inputs = fail_sensor(config, example, failure, severity, key=key)
        return jax.tree.map(lambda a: a[None], inputs)

    return jax.jit(run)


def failed_inputs(
    config: DetectorConfig,
    example: Example,
    *,
    failure: str | None = None,
    severity: float = 1.0,
    seed: int = 0,
    position: int = 0,
) -> Inputs:
    """What `run_detector` lets the network read of the frame at a position, a batch of one."""
    # Models with and without a gate read the same inputs.
    plain = dataclasses.replace(
        config, model="dense" if config.is_dense else "avod", fixed_weights=None
    )
    key = jax.random.fold_in(jax.random.key(seed), position)
    made: Inputs = _inputs(plain, failure)(key, example, jnp.float32(severity))
    return made


@functools.lru_cache(maxsize=8)
def _detect(config: DetectorConfig) -> Callable[..., Detections]:
    return jax.jit(functools.partial(dense_detect if config.is_dense else detect, config))


def run_detector(
    config: DetectorConfig,
    state: DetectorState,
    examples: Iterable[Example],
    *,
    failure: str | None = None,
    severity: float = 1.0,
    seed: int = 0,
    calibration: Calibration | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> list[Detections]:
    """Detections of every frame, on the host.

    Args:
        config: static.
        state: trained.
        examples: frames, taken one at a time.
        failure: of `FAILURES`, in every frame; None for none.
        severity: of the failure; seed: of its noise, which depends on the frame's position too.
        calibration: of the told failures (`calibrate_told_failures`); they are as the head tells
            them when left out.
        on_frame: called with the number of frames done.

    Returns:
        One `Detections` per frame, in order.
    """
    run, reading = _detect(config), AS_TOLD if calibration is None else calibration
    out = []
    for i, example in enumerate(examples):
        inputs = failed_inputs(
            config, example, failure=failure, severity=severity, seed=seed, position=i
        )
        found = run(state.params["main"], state.stats, inputs, reading)
        found = jax.tree.map(lambda a: a[0], found)
        out.append(jax.device_get(found))
        if on_frame is not None:
            on_frame(i + 1)
    return out


def sensor_mask(failure: str | None, n: int) -> np.ndarray:
    """Which of (camera, lidar) a failure concerns, for n frames `[n, 2]`."""
    sensor = "" if failure is None else failure.partition("_")[0]
    return np.tile(np.array([sensor == "camera", sensor == "lidar"]), (n, 1))
