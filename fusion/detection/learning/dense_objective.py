r"""What training of the one-stage detector minimizes, and its detections.

.. math::
    L = L_{heat} + \rho \, L_{box} + \eta \, L_{o} + \alpha \sum_k w_k L^{aux}_k
      + \beta \sum_k \big(w_k - f_k(L^{aux})\big)^2 + \dots

The heat has a focal loss over all cells but the ignored ones (vans, DontCare regions), divided by
the number of cars; the box an absolute error
over the cells near one: a hit needs boxes right to a decimetre, where a smooth L1 hardly pulls;
:math:`L_o` is what lacks to a full overlap there (`box_overlap`).
:math:`L^{aux}_k` is the same of a head that reads view k alone; the gate's terms are those of
`gate_objective`.

Source: Zhou, Wang, Kraehenbuehl (2019), Eq. 1; Shim (2020), Eq. 3.2.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import ground_box
from fusion.detection.geometry.suppression import nms
from fusion.detection.learning.box_overlap import overlap_loss
from fusion.detection.learning.dense_targets import (
    GridTargets,
    average_cells,
    decode_cells,
    grid_targets,
)
from fusion.detection.learning.gate_objective import PathLosses, failure_loss, gate_terms
from fusion.detection.learning.objective import DetectorLoss
from fusion.detection.learning.params import DetectorParams
from fusion.detection.network.dense import DenseAuxiliary, DenseDetector, Grids
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import Detections
from fusion.detection.sensors.platt import Calibration, rescaled
from fusion.gating import drop_modalities


def _per_frame(values: Array, counted: Array) -> Array:
    """Mean over the cells that count, of every frame; 0 where there is none."""
    axes = tuple(range(1, counted.ndim))
    n = counted.astype(values.dtype).sum(axis=axes)
    return jnp.where(counted, values, 0.0).sum(axis=axes) / jnp.maximum(1.0, n)


def grid_losses(
    outputs: Float[Array, "b r s 11"], targets: GridTargets
) -> tuple[Float[Array, "b"], Float[Array, "b"], Float[Array, "b"]]:
    """Heat, box and balanced class loss of every frame.

    The last one weighs cars' centres and the background alike, as `balanced_class_loss`.
    """
    logit = outputs[..., 0]
    hot, cold = jax.nn.log_sigmoid(logit), jax.nn.log_sigmoid(-logit)
    share = jax.nn.sigmoid(logit)
    centre = targets.centre
    losses = jnp.where(
        centre, -((1.0 - share) ** 2) * hot, -((1.0 - targets.heat) ** 4) * share**2 * cold
    )
    losses = jnp.where(targets.ignored, 0.0, losses)
    n = jnp.maximum(1.0, centre.astype(logit.dtype).sum(axis=(1, 2)))
    heat = losses.sum(axis=(1, 2)) / n
    error = jnp.abs(outputs[..., 1:] - targets.boxes).sum(axis=-1)
    background = (targets.heat < 0.1) & ~targets.ignored
    balanced = 0.5 * _per_frame(-hot, centre) + 0.5 * _per_frame(-cold, background)
    return heat, _per_frame(error, targets.near), balanced


def dense_loss(
    config: DetectorConfig,
    hyper: DetectorParams,
    params: Any,
    stats: Any,
    inputs: Inputs,
    failed: Bool[Array, "b 2"] | None = None,
    *,
    key: PRNGKeyArray,
) -> tuple[Array, tuple[DetectorLoss, Any]]:
    """Training loss of a batch of frames and its terms; arguments are those of `detector_loss`."""
    model: Any = DenseDetector(config)
    main = {"params": params["main"]}
    b = inputs.image.shape[0]
    grids: Grids = model.apply(main, inputs, method="encode")
    kept = drop_modalities(jnp.ones((2, b, 1)), config.path_drop, key=key)[:, :, 0].T
    outputs = model.apply(main, grids, 2.0 * grids.weights * kept, method="head")
    targets = jax.vmap(lambda frame: grid_targets(config, frame))(inputs)
    heat, boxes, _ = grid_losses(outputs, targets)
    lacks = jax.vmap(partial(overlap_loss, config))(outputs[..., 1:], targets, inputs.plane)
    gate = of_paths = regularization = jnp.zeros(())
    if config.gated:
        heads: Any = DenseAuxiliary(config)
        read = grids.camera, grids.lidar
        if not config.auxiliary_trains_views:
            read = jax.lax.stop_gradient(read)
        views = heads.apply({"params": params["auxiliary"]}, *read)
        parts = [grid_losses(view, targets) for view in views]
        whole = [h + config.regression_weight * o for h, o, _ in parts]
        counted = targets.centre.any(axis=(1, 2)).astype(jnp.float32)
        balanced = jnp.stack([e for *_, e in parts], axis=1)
        paths = PathLosses(jnp.stack(whole, axis=1), balanced, counted)
        gate, of_paths, regularization = gate_terms(
            config, hyper.gate, params, grids.weights, [paths]
        )
    failure = failure_loss(grids.failed, failed)
    boxes = config.regression_weight * boxes + config.dense.overlap_weight * lacks
    total = (heat + boxes).mean() + gate
    total = total + hyper.failure_label * failure
    zero = jnp.zeros(())
    terms = DetectorLoss(
        total, zero, zero, heat.mean(), boxes.mean(), zero, of_paths, regularization, failure,
        targets.near.sum(axis=(1, 2)).astype(jnp.float32).mean(),
        targets.centre.sum(axis=(1, 2)).astype(jnp.float32).mean(),
        grids.weights,
    )  # fmt: skip
    return total, (terms, stats)


def dense_detect(
    config: DetectorConfig,
    main: Any,
    stats: Any,
    inputs: Inputs,
    calibration: Calibration | None = None,
) -> Detections:
    """Detections of a batch of frames, inside jit: peaks of the heat, rotated suppression.

    A peak's box is the mean of what the cells around it tell (`average_cells`).

    Arguments are those of `detect`.
    """
    model: Any = DenseDetector(config)
    grids: Grids = model.apply({"params": main}, inputs, method="encode")
    outputs = model.apply({"params": main}, grids, 2.0 * grids.weights, method="head")

    def one(output: Array, plane: Array, weights: Array, failed: Array) -> Detections:
        heat = jax.nn.sigmoid(output[..., 0])
        around = jax.lax.reduce_window(heat, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
        score = jnp.where(heat >= around, heat, 0.0).ravel()
        top, index = jax.lax.top_k(score, min(config.dense.candidates, score.shape[0]))
        told = average_cells(config, output)[..., 1:]
        boxes = decode_cells(config, told, plane)[index]
        sound = jnp.isfinite(boxes).all(axis=1) & (top >= config.score_threshold) & (top > 0)
        kept, found = nms(
            ground_box(boxes),
            top,
            sound,
            iou_threshold=config.dense.nms,
            max_output=config.max_detections,
            max_candidates=config.dense.candidates,
            overlap="rotated",
        )
        scores = jnp.where(found, top[kept], 0.0)
        return Detections(boxes[kept], scores, found, weights, jax.nn.sigmoid(failed))

    told = rescaled(calibration, grids.failed)
    return jax.vmap(one)(outputs, inputs.plane, grids.weights, told)
