r"""The way through both stages, one for training and detection.

Maps and weights of a frame are computed once (`encode`). Then each stage crops both views at its
boxes, fuses the crops with the scaled weights and scores them: the first stage at anchors
(`score_anchors`), the second at proposals (`score_proposals`). Training scores mini-batches with
gradients and detection all boxes, through the same functions.

Source: Ku et al. (2018), section III.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.network.detector import Detector, Encoded, crop_views, fuse
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import propose, view_boxes


class Scored(NamedTuple):
    """A stage's outputs on the fused crops, and the crops of both views.

    Attributes:
        crops: two arrays `[b, n, size, size, c]`.
        outputs: class scores `[b, n, 2]`, offsets, and in the second stage the angle vector.
    """

    crops: tuple[Array, Array]
    outputs: tuple[Array, ...]


def encode(
    config: DetectorConfig, main: Any, stats: Any, inputs: Inputs, *, train: bool
) -> tuple[Encoded, Any]:
    """Maps and fusion weights of a batch of frames, and the statistics of batch norm after it.

    Args:
        config: static.
        main: `params["main"]` of `init_detector`.
        stats: of batch norm; those of the batch are used, and kept, in training.
        inputs: batch of frames.
        train: static.
    """
    variables = {"params": main, "batch_stats": stats}
    if not train:
        model: Any = Detector(config)
        return model.apply(variables, inputs.image, inputs.bev, False, method="encode"), stats
    encoded, changed = Detector(config).apply(
        variables, inputs.image, inputs.bev, True, method="encode", mutable=["batch_stats"]
    )
    return encoded, changed.get("batch_stats", {})


def _score(
    config: DetectorConfig,
    main: Any,
    maps: tuple[Array, Array],
    scale: Array,
    inputs: Inputs,
    boxes: Array,
    size: int,
    method: str,
    key: PRNGKeyArray | None,
) -> Scored:
    locate = jax.vmap(lambda a, p, s: view_boxes(config, a, p, s))
    crops = crop_views(maps, locate(boxes, inputs.p2, inputs.image_size), size)
    rngs = {} if key is None else {"dropout": key}
    model: Any = Detector(config)
    fused = fuse(crops, scale)
    return Scored(
        crops, model.apply({"params": main}, fused, key is not None, method=method, rngs=rngs)
    )


def score_anchors(
    config: DetectorConfig,
    main: Any,
    encoded: Encoded,
    scale: Float[Array, "b 2"],
    inputs: Inputs,
    anchors: Float[Array, "b n 6"],
    *,
    key: PRNGKeyArray | None = None,
) -> Scored:
    """The first stage at anchors: scores of background and object, six offsets.

    Args:
        config: static.
        main: `params["main"]`.
        encoded: of `encode`.
        scale: factors of both views, 2 w without path drop.
        inputs: where the cameras of the frames look.
        anchors: of every frame.
        key: of dropout; None for none.
    """
    return _score(
        config, main, encoded.maps, scale, inputs, anchors, config.rpn_crop, "first_stage", key
    )


def score_proposals(
    config: DetectorConfig,
    main: Any,
    encoded: Encoded,
    scale: Float[Array, "b 2"],
    inputs: Inputs,
    proposals: Float[Array, "b n 6"],
    *,
    key: PRNGKeyArray | None = None,
) -> Scored:
    """The second stage at proposals: class scores, ten corner offsets, angle vector.

    Arguments are those of `score_anchors`.
    """
    size = config.second_crop
    return _score(
        config, main, encoded.features, scale, inputs, proposals, size, "second_stage", key
    )


def propose_boxes(
    config: DetectorConfig,
    main: Any,
    encoded: Encoded,
    scale: Float[Array, "b 2"],
    inputs: Inputs,
    n_proposals: int,
) -> tuple[Float[Array, "b n 6"], Bool[Array, "b n"]]:
    """Proposals from all anchors, without gradient, and which rows hold one."""
    main, encoded, scale = jax.lax.stop_gradient((main, encoded, scale))
    _, scored = score_anchors(config, main, encoded, scale, inputs, inputs.anchors)
    boxes, found = jax.vmap(lambda a, m, o, d: propose(config, a, m, o, d, n_proposals))(
        inputs.anchors, inputs.anchor_mask, *scored
    )
    return jax.lax.stop_gradient(boxes), jnp.asarray(found)
