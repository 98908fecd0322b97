"""One training step of the detector: sensors fail, frames flip, Adam steps, the lattice projects.

Pure functions; jit is the caller's. Both models see the same failures for the same key.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.dense_objective import dense_loss
from fusion.detection.learning.examples import Example, frame_depth, make_inputs
from fusion.detection.learning.objective import DetectorLoss, detector_loss
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.pasting import paste_objects
from fusion.detection.learning.sharding import map_frames
from fusion.detection.network.build import init_detector
from fusion.detection.network.inputs import Inputs
from fusion.detection.sensors.camera_failures import (
    CAMERA_FAILURES,
    camera_failure,
    random_camera_failure,
)
from fusion.detection.sensors.lidar_failures import (
    LIDAR_FAILURES,
    lidar_failure,
    random_lidar_failure,
)
from fusion.detection.sensors.misalignment import MISALIGNMENTS, misaligned
from fusion.targets import project_targets

SENSOR_FAILURES: tuple[str, ...] = (
    *(f"camera_{kind}" for kind in CAMERA_FAILURES),
    *(f"lidar_{kind}" for kind in LIDAR_FAILURES),
)
"""Names of single-sensor failures, `camera_blackout` and so on."""
FAILURES: tuple[str, ...] = (*SENSOR_FAILURES, *MISALIGNMENTS)
"""These, and the failures of both sensors together, which training never sees."""


@dataclasses.dataclass(frozen=True)
class DetectorTrainConfig:
    """How the detector is trained, static; the defaults are the source's.

    Attributes:
        steps, batch_size: length of the training and frames a step.
        schedule: of the learning rate; `staircase` multiplies by 0.8 every 30,000 steps, `cosine`
            falls to zero after a warm-up over the first 5 %.
        flip: mirror half of the frames; colour_sd: shift of the colour channels.
        rotation: largest angle that the scene is turned by [degree]; scaling: largest change of its
            size as a share; both drawn evenly, see `turn_and_scale`.
        pasting: share of another frame's objects of the batch that are pasted into each frame
            where there is room, see `paste_objects`.
        failure_share: frames in which one sensor fails (half camera, half lidar); the source keeps
            a third clean in its other experiments.
        severity: least severity of these failures; drawn evenly up to 1.
        failure_kinds: of `SENSOR_FAILURES`, which ones training sees.

    Raises:
        ValueError: counts, shares or names out of range.

    Example:
        >>> DetectorTrainConfig(steps=100, schedule="cosine").batch_size
        1
    """

    steps: int = 120_000
    batch_size: int = 1
    schedule: Literal["staircase", "cosine"] = "staircase"
    flip: bool = True
    colour_sd: float = 0.02
    rotation: float = 0.0
    scaling: float = 0.0
    pasting: float = 0.0
    failure_share: float = 0.0
    severity: float = 0.5
    failure_kinds: tuple[str, ...] = SENSOR_FAILURES

    def __post_init__(self) -> None:
        """Check counts, shares and names."""
        if self.steps < 1 or self.batch_size < 1:
            raise ValueError(
                f"steps={self.steps}, batch_size={self.batch_size}: expected at least 1"
            )
        if self.schedule not in ("staircase", "cosine"):
            raise ValueError(f"schedule={self.schedule!r}: expected 'staircase' or 'cosine'")
        if not 0 <= self.colour_sd < 1:
            raise ValueError(f"colour_sd={self.colour_sd}: expected a standard deviation in [0, 1)")
        if not (0 <= self.rotation <= 45 and 0 <= self.scaling < 0.5):
            raise ValueError(
                f"rotation={self.rotation}, scaling={self.scaling}: expected an angle up to 45 "
                "degrees and a share below 0.5"
            )
        if not 0 <= self.pasting <= 1:
            raise ValueError(f"pasting={self.pasting}: expected a share in [0, 1]")
        if self.pasting and self.batch_size < 2:
            raise ValueError(
                f"pasting={self.pasting}, batch_size={self.batch_size}: expected at least 2 frames "
                "a step, whose objects are pasted into each other"
            )
        if not (0 <= self.failure_share <= 1 and 0 < self.severity <= 1):
            raise ValueError(
                f"failure_share={self.failure_share}, severity={self.severity}: expected shares "
                "in [0, 1], the severity above 0"
            )
        unknown = [kind for kind in self.failure_kinds if kind not in SENSOR_FAILURES]
        if unknown:
            raise ValueError(
                f"failure_kinds={unknown[0]!r}: expected of {', '.join(SENSOR_FAILURES)}"
            )
        sensors = {kind.partition("_")[0] for kind in self.failure_kinds}
        if self.failure_share > 0 and sensors != {"camera", "lidar"}:
            raise ValueError(
                f"failure_kinds={self.failure_kinds}: expected at least one of each sensor, since "
                "half of the failures are the camera's and half the lidar's"
            )


class DetectorState(NamedTuple):
    """What a step changes: parameters, statistics of batch norm, optimizer, step number."""

    params: Any
    stats: Any
    opt_state: Any
    step: Array


def learning_rate(train: DetectorTrainConfig, hyper: DetectorParams, step: Array) -> Array:
    """The learning rate of a step."""
    at = step.astype(jnp.float32)
    if train.schedule == "staircase":
        return hyper.learning_rate * 0.8 ** jnp.floor(at / 30_000)
    warm = jnp.minimum(1.0, (at + 1) / max(1.0, 0.05 * train.steps))
    phase = jnp.minimum(1.0, at / train.steps)
    return hyper.learning_rate * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * phase))


def _l2(hyper: DetectorParams, params: Any) -> Any:
    """Decay of every parameter: kernels only; the lattice holds targets, not weights."""

    def decay(path: Any, _: Array) -> Any:
        names = [str(getattr(entry, "key", entry)) for entry in path]
        if names[-1] != "kernel":
            return 0.0
        return hyper.l2_dense if "second" in names else hyper.l2

    return jax.tree_util.tree_map_with_path(decay, params)


def _parts(params: Any) -> dict[str, str]:
    """Which optimizer moves what."""
    beside = ("targets", "mean_losses")
    return {name: "targets" if name in beside else "network" for name in params}


def _optimizer(hyper: DetectorParams) -> optax.GradientTransformation:
    clip = optax.clip_by_global_norm(hyper.clip_norm)
    parts = {
        "network": optax.chain(clip, optax.scale_by_adam()),
        "targets": optax.chain(optax.scale_by_adam(), optax.scale(hyper.target_rate)),
    }
    return optax.partition(parts, _parts)


def init_training(key: PRNGKeyArray, config: DetectorConfig) -> DetectorState:
    """Fresh parameters and optimizer, whose state depends on no rate."""
    params, stats = init_detector(key, config)
    optimizer = _optimizer(DetectorParams())
    return DetectorState(params, stats, optimizer.init(params), jnp.zeros((), jnp.int32))


def fail_sensor(
    config: DetectorConfig,
    example: Example,
    failure: str,
    severity: float | Array = 1.0,
    *,
    key: PRNGKeyArray,
) -> Inputs:
    """Inputs of one frame of which a sensor, or both together, have failed, to test robustness.

    Args:
        config: static.
        example: one frame.
        failure: of `FAILURES` (static).
        severity: in [0, 1].
        key: of the failure's noise.

    Raises:
        ValueError: unknown failure.
    """
    if failure not in FAILURES:
        raise ValueError(f"failure={failure!r}: expected one of {', '.join(FAILURES)}")
    sensor, _, kind = failure.partition("_")
    concerned = jnp.array([sensor != "lidar", sensor != "camera"], jnp.float32)
    told = jnp.asarray(severity, jnp.float32) * concerned
    if sensor == "camera":
        image = jnp.asarray(example.image).astype(jnp.float32) / 255.0
        depth = frame_depth(config, example) if kind == "fog" else None
        failed_image = camera_failure(image, kind, severity, key=key, depth=depth)
        return make_inputs(config, example, image=failed_image, told=told)
    points, mask = jnp.asarray(example.points), jnp.asarray(example.point_mask)
    if failure in MISALIGNMENTS:
        frame = (example.to_camera, example.truth, example.truth_mask)
        to_camera, truth, labelled = (jnp.asarray(a) for a in frame)
        points = misaligned(points, mask, to_camera, truth, labelled, failure, severity, key=key)
        return make_inputs(config, example, points=(points, mask), told=told)
    failed = lidar_failure(points, mask, kind, severity, key=key, beams=config.beam_elevations)
    return make_inputs(config, example, points=failed, told=told)


def training_inputs(
    config: DetectorConfig, train: DetectorTrainConfig, example: Example, *, key: PRNGKeyArray
) -> tuple[Inputs, Array]:
    """Inputs of one training frame, and which of (camera, lidar) fails in it `[2]`."""
    which, strength, noise, mirror, colour = jax.random.split(key, 5)
    image = jnp.asarray(example.image).astype(jnp.float32) / 255.0
    points, mask = jnp.asarray(example.points), jnp.asarray(example.point_mask)
    u = jax.random.uniform(which)
    failed = jnp.stack([u < 0.5 * train.failure_share, u >= 1.0 - 0.5 * train.failure_share])
    told = jnp.zeros(2, jnp.float32)
    if train.failure_share > 0:
        severity = jax.random.uniform(strength, minval=train.severity, maxval=1.0)
        told = severity * failed.astype(jnp.float32)
        kinds: dict[str, list[str]] = {"camera": [], "lidar": []}
        for name in train.failure_kinds:
            kinds[name.partition("_")[0]].append(name.partition("_")[2])
        foggy = "fog" in kinds["camera"]
        image = jax.lax.cond(
            failed[0],
            lambda: random_camera_failure(
                image,
                severity,
                kinds=kinds["camera"],
                key=noise,
                depth=frame_depth(config, example) if foggy else None,
            ),
            lambda: image,
        )
        lose = partial(random_lidar_failure, kinds=kinds["lidar"], beams=config.beam_elevations)
        points, mask = jax.lax.cond(
            failed[1],
            lambda: lose(points, mask, severity, key=noise),
            lambda: (points, mask),
        )
    turn = None
    if train.rotation or train.scaling:
        u = jax.random.uniform(jax.random.fold_in(mirror, 1), (2,), minval=-1.0, maxval=1.0)
        turn = math.radians(train.rotation) * u[0], 1.0 + train.scaling * u[1]
    inputs = make_inputs(
        config,
        example,
        image=image,
        points=(points, mask),
        mirror=jax.random.bernoulli(mirror) if train.flip else None,
        turn=turn,
        key=colour,
        colour_sd=train.colour_sd,
        told=told,
    )
    return inputs, failed


def train_step(
    config: DetectorConfig,
    train: DetectorTrainConfig,
    hyper: DetectorParams,
    state: DetectorState,
    batch: Example,
    *,
    key: PRNGKeyArray,
    mesh: Mesh | None = None,
) -> tuple[DetectorState, DetectorLoss, Array]:
    r"""One step of Adam with L2, then the projection of the lattice.

    .. math:: \theta \leftarrow \Pi(\theta - \eta \, \mathrm{Adam}(\nabla L + \lambda \theta))

    Args:
        config, train: static.
        hyper: rates and weights; another value compiles nothing anew.
        state: as from `init_training`.
        batch: examples with a leading axis.
        key: of this step; the frames' failures and flips do not depend on the model.
        mesh: devices that share the frames (static), as from `frame_mesh`.

    Returns:
        the new state, the terms of the loss, and which sensors failed `[b, 2]`.
    """
    input_key, loss_key = jax.random.split(key)
    keys = jax.random.split(input_key, batch.image.shape[0])
    if train.pasting:
        others = jax.tree.map(lambda a: jnp.roll(jnp.asarray(a), 1, axis=0), batch)
        batch = jax.vmap(lambda k, e, o: paste_objects(e, o, train.pasting, key=k))(
            jax.random.split(jax.random.fold_in(input_key, 1), len(keys)), batch, others
        )
    # One frame after the other: under vmap every kind of failure would be computed each time.
    inputs, failed = map_frames(
        lambda a: training_inputs(config, train, a[1], key=a[0]), (keys, batch), mesh
    )
    loss = dense_loss if config.is_dense else detector_loss
    gradient = jax.value_and_grad(loss, argnums=2, has_aux=True)
    (_, (terms, stats)), grads = gradient(
        config, hyper, state.params, state.stats, inputs, failed, key=loss_key
    )
    decayed = jax.tree.map(lambda g, p, d: g + d * p, grads, state.params, _l2(hyper, grads))
    updates, opt_state = _optimizer(hyper).update(decayed, state.opt_state, state.params)
    rate = learning_rate(train, hyper, state.step)
    params = jax.tree.map(lambda p, u: p - rate * u, state.params, updates)
    if "targets" in params:
        params["targets"] = project_targets(config.targets, params["targets"])
    return DetectorState(params, stats, opt_state, state.step + 1), terms, failed
