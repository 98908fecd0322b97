r"""What training minimizes: the losses of both stages, and the gate's of Equation 3.2.

.. math::
    L = L^{rpn}_{cls} + 5 L^{rpn}_{reg} + L^{2}_{cls} + 5 L^{2}_{reg} + L^{2}_{ang}
      + \alpha \sum_k w_k L^{aux}_k + \beta \sum_k \big(w_k - f_k(L^{aux})\big)^2 + \dots

:math:`L^{aux}_k` is the loss of both stages of a path that reads view k alone. `avod` has the first
five terms. See `gate_objective` for the last three.

Source: Ku et al. (2018), section III-E; Shim (2020), Eq. 3.2 and section 3.3.2.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import (
    anchor_ground,
    angle_vector,
    box3d_to_anchor,
    box3d_to_box4c,
    decode_offsets,
    encode_offsets,
)
from fusion.detection.learning.detection_loss import regression_loss
from fusion.detection.learning.gate_objective import (
    PathLosses,
    class_losses,
    failure_loss,
    gate_terms,
    path_losses,
)
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.sampling import assign, draw
from fusion.detection.network.detector import AuxiliaryHeads
from fusion.detection.network.forward import (
    encode,
    propose_boxes,
    score_anchors,
    score_proposals,
)
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import anchor_boxes
from fusion.gating import drop_modalities

_JITTER_PLACE, _JITTER_SIZE = 0.1, 0.05  # of copies of labels among the proposals


class DetectorLoss(NamedTuple):
    """Terms of the loss, means over the frames; `total` is what is minimized.

    Attributes:
        total: with all weights.
        rpn_classes, rpn_boxes: first stage.
        classes, boxes, angle: second stage.
        auxiliary, regularization: of the gate; 0 for `avod`.
        failure: cross entropy of the failures that the gate tells; 0 where it tells none.
        rpn_positives, positives: boxes that are objects in the mini-batches, per frame.
        weights: `[b, 2]` fusion weights of the frames.
    """

    total: Array
    rpn_classes: Array
    rpn_boxes: Array
    classes: Array
    boxes: Array
    angle: Array
    auxiliary: Array
    regularization: Array
    failure: Array
    rpn_positives: Array
    positives: Array
    weights: Array


def _take(values: Array, indices: Array) -> Array:
    """Rows of every frame."""
    return jax.vmap(lambda v, i: v[i])(values, indices)


def _safe_truth(inputs: Inputs) -> Array:
    """Labels with unit boxes for padding: logarithms of empty boxes would poison gradients."""
    unit = jnp.array([0.0, 0, 0, 1, 1, 1, 0])
    return jnp.where(inputs.truth_mask[..., None], inputs.truth, unit[None, None])


def _with_truth(
    key: PRNGKeyArray,
    proposals: Array,
    found: Array,
    truth: Array,
    inputs: Inputs,
    n_copies: int,
) -> tuple[Array, Array]:
    """Proposals and `n_copies` shifted copies of each label, of every frame."""
    if not n_copies:
        return proposals, found
    copies = jnp.tile(truth, (1, n_copies, 1))
    sd = jnp.array([_JITTER_PLACE] * 3 + [_JITTER_SIZE] * 3)[None, None]
    noise = sd * jax.random.normal(key, copies.shape)
    shifted = jax.vmap(decode_offsets)(copies, noise)
    mask = jnp.tile(inputs.truth_mask, (1, n_copies))
    return jnp.concatenate([proposals, shifted], 1), jnp.concatenate([found, mask], 1)


def _assign(boxes: Array, mask: Array, truth: Array, inputs: Inputs, limits: Any) -> Any:
    """Which boxes of every frame are objects."""
    one = jax.vmap(lambda a, m, t, tm: assign(anchor_ground(a), m, t, tm, limits))
    return one(boxes, mask, truth, inputs.truth_mask)


def detector_loss(
    config: DetectorConfig,
    hyper: DetectorParams,
    params: Any,
    stats: Any,
    inputs: Inputs,
    failed: Bool[Array, "b 2"] | None = None,
    *,
    key: PRNGKeyArray,
) -> tuple[Array, tuple[DetectorLoss, Any]]:
    """Training loss of a batch of frames, its terms, and the new statistics of batch norm.

    Anchors are scored without gradient to make proposals; gradients flow through the mini-batches
    alone, which are cut out once more. So a step costs little more than the two pyramids.

    Args:
        config: static.
        hyper: weights of the gate's terms.
        params: of `init_detector`; differentiable.
        stats: of batch norm.
        inputs: batch of frames.
        failed: which of (camera, lidar) failed in each frame, if that is known.
        key: of mini-batches, dropout and path drop.
    """
    c, b = config, inputs.image.shape[0]
    path_key, rpn_key, second_key, jitter_key, drop1, drop2, drop3 = jax.random.split(key, 7)
    drop4 = jax.random.fold_in(drop2, 1)
    main = params["main"]
    encoded, new_stats = encode(c, main, stats, inputs, train=True)
    kept = drop_modalities(jnp.ones((2, b, 1)), c.path_drop, key=path_key)[:, :, 0].T
    scale = 2.0 * encoded.weights * kept
    truth = _safe_truth(inputs)
    truth_anchors = jax.vmap(lambda t: box3d_to_anchor(t, square=True))(truth)
    truth_ground = jax.vmap(anchor_ground)(truth_anchors)

    # First stage: proposals of all anchors, losses of a mini-batch.
    proposals, found = propose_boxes(c, main, encoded, scale, inputs, c.proposals_train)
    assigned = _assign(inputs.anchors, inputs.anchor_mask, truth_ground, inputs, c.rpn_iou)
    sample = jax.vmap(lambda k, a: draw(a, c.rpn_batch, key=k))(
        jax.random.split(rpn_key, b), assigned
    )
    match = _take(assigned.match, sample.indices)
    anchors = _take(inputs.anchors, sample.indices)
    target = jax.vmap(encode_offsets)(anchors, _take(truth_anchors, match))
    crops, (scores, offsets) = score_anchors(c, main, encoded, scale, inputs, anchors, key=drop1)
    rpn_classes = class_losses(c, scores, sample)
    rpn_boxes = jax.vmap(regression_loss)(offsets, target, sample)
    paths: list[PathLosses] = []
    heads: Any = AuxiliaryHeads(c)
    if c.gated:
        auxiliary = {"params": params["auxiliary"]}
        outputs = heads.apply(auxiliary, crops, True, method="first_stage", rngs={"dropout": drop2})
        paths.append(path_losses(c, outputs, (target,), sample))

    # Second stage: a mini-batch of proposals.
    proposals, found = _with_truth(
        jitter_key, proposals, found, truth_anchors, inputs, c.truth_proposals
    )
    assigned = _assign(proposals, found, truth_ground, inputs, c.second_iou)
    sample2 = jax.vmap(lambda k, a: draw(a, c.second_batch, key=k))(
        jax.random.split(second_key, b), assigned
    )
    rois, match = _take(proposals, sample2.indices), _take(assigned.match, sample2.indices)
    crops, (scores, offsets, angle) = score_proposals(
        c, main, encoded, scale, inputs, rois, key=drop3
    )
    corners = jax.vmap(box3d_to_box4c)
    moves = _take(corners(truth, inputs.plane), match)
    moves = moves - corners(jax.vmap(anchor_boxes)(rois), inputs.plane)
    heading = jax.vmap(angle_vector)(_take(truth[..., 6:], match)[..., 0])
    classes = class_losses(c, scores, sample2)
    boxes = jax.vmap(regression_loss)(offsets, moves, sample2)
    angles = jax.vmap(regression_loss)(angle, heading, sample2)
    gate = of_paths = regularization = jnp.zeros(())
    if c.gated:
        if c.auxiliary_second:
            outputs = heads.apply(
                auxiliary, crops, True, method="second_stage", rngs={"dropout": drop4}
            )
            paths.append(path_losses(c, outputs, (moves, heading), sample2))
        gate, of_paths, regularization = gate_terms(c, hyper.gate, params, encoded.weights, paths)

    frames = (
        rpn_classes
        + c.regression_weight * rpn_boxes
        + classes
        + c.regression_weight * boxes
        + c.angle_weight * angles
    )
    failure = failure_loss(encoded.failed, failed)
    total = frames.mean() + gate + hyper.failure_label * failure
    terms = DetectorLoss(
        total, rpn_classes.mean(), rpn_boxes.mean(), classes.mean(), boxes.mean(), angles.mean(),
        of_paths, regularization, failure,
        sample.positive.sum(axis=1).astype(jnp.float32).mean(),
        sample2.positive.sum(axis=1).astype(jnp.float32).mean(),
        encoded.weights,
    )  # fmt: skip
    return total, (terms, new_stats)
