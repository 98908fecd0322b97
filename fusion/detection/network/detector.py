"""AVOD and AVOD-ARGate: the networks between the two views and the scores of anchors and boxes.

The sensors are in the order (camera, lidar) everywhere. `Detector` is what is used after training;
`AuxiliaryHeads` and the lattice of the targets are there in training only.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.network.crop import crop_and_resize
from fusion.detection.network.heads import (
    SENSORS,
    CleanReadings,
    MapGate,
    QualityHead,
    RpnHead,
    SecondHead,
)
from fusion.detection.network.initialize import init_weights
from fusion.detection.network.views import FeaturePyramid
from fusion.detection.sensors.quality import quality_statistics
from fusion.targets import init_targets

# Output layers start small: even class scores, boxes at their anchors. The gate's starts at zero,
# so that training starts from equal weights, as AVOD fuses.
_OUTPUTS = {
    "objectness": 0.01, "offsets": 0.01, "classes": 0.01, "angle": 0.01,
    "fusion": 0.0,
}  # fmt: skip


class Encoded(NamedTuple):
    """Of a batch of frames: feature maps and one-channel maps of (camera, lidar), fusion weights.

    Attributes:
        features: two arrays `[b, h, w, f]`.
        maps: two arrays `[b, h, w, 1]`.
        weights: `[b, 2]`, sum to one.
        failed: `[b, 2]` log odds that the sensor has failed; NaN without a gate that tells.
    """

    features: tuple[Array, Array]
    maps: tuple[Array, Array]
    weights: Array
    failed: Array


class Detector(nn.Module):
    """The main network; use its methods through `apply(..., method=...)`."""

    config: DetectorConfig

    def setup(self) -> None:
        """Both views, the gate of `avod_argate`, both stages' heads."""
        c = self.config
        self.views = [
            FeaturePyramid(c.widths, c.layers, c.norm, c.precision, name=f"{sensor}_view")
            for sensor in SENSORS
        ]
        self.reduce = [nn.Conv(1, (1, 1), name=f"{sensor}_map") for sensor in SENSORS]
        if c.gated:
            self.gate = MapGate(c.gate_width, c.normalizer)
            if c.gate_statistics:
                self.clean = CleanReadings()
                self.quality = QualityHead()
        self.rpn = RpnHead(c.rpn_width, c.dropout)
        self.second = SecondHead(c.fc_widths, c.dropout)

    def encode(
        self, image: Float[Array, "b h w 3"], bev: Float[Array, "b r c s"], train: bool
    ) -> Encoded:
        """Maps of both views and the fusion weights (0.5 each without a gate)."""
        camera = teach_if_alive(self.views[0](image, train), image)
        lidar = teach_if_alive(self.views[1](bev, train), bev)
        maps = (nn.relu(self.reduce[0](camera)), nn.relu(self.reduce[1](lidar)))
        failed = jnp.full((image.shape[0], 2), jnp.nan)
        if not self.config.gated:
            return Encoded((camera, lidar), maps, jnp.full((image.shape[0], 2), 0.5), failed)
        if not self.config.gate_statistics:
            return Encoded((camera, lidar), maps, self.gate(maps), failed)
        failed = self.quality(self.clean(quality_statistics(self.config.bev, image, bev)))
        return Encoded((camera, lidar), maps, self.gate(maps, failed), failed)

    def first_stage(self, crops: Array, train: bool) -> tuple[Array, Array]:
        """`RpnHead` on fused crops of the one-channel maps."""
        return self.rpn(crops, train)

    def second_stage(self, crops: Array, train: bool) -> tuple[Array, Array, Array]:
        """`SecondHead` on fused crops of the feature maps."""
        return self.second(crops, train)

    def __call__(self, image: Array, bev: Array) -> Encoded:
        """Touch every parameter once (for `init`)."""
        c = self.config
        encoded = self.encode(image, bev, False)
        self.rpn(jnp.zeros((1, c.rpn_crop, c.rpn_crop, 1)), False)
        self.second(jnp.zeros((1, c.second_crop, c.second_crop, c.widths[0])), False)
        return encoded


def teach_if_alive(features: Array, reading: Array) -> Array:
    """Features that pass no gradient where the sensor's reading is one constant.

    A dead sensor teaches its view nothing, but normalization of maps without variance multiplies
    the gradient by some 30 in each layer, which no clipping of the sum mends.
    """
    axes = (1, 2, 3)
    alive = reading.max(axis=axes, keepdims=True) > reading.min(axis=axes, keepdims=True)
    return jnp.where(alive, features, jax.lax.stop_gradient(features))


class AuxiliaryHeads(nn.Module):
    """A path through both stages for each view, on that view's crops alone (training only)."""

    config: DetectorConfig

    def setup(self) -> None:
        """Heads of the main network's sizes."""
        c = self.config
        self.rpn = [RpnHead(c.rpn_width, c.dropout, name=sensor) for sensor in SENSORS]
        if c.auxiliary_second:
            self.second = [
                SecondHead(c.fc_widths, c.dropout, name=f"{sensor}_second") for sensor in SENSORS
            ]

    def first_stage(self, crops: tuple[Array, Array], train: bool) -> list[tuple[Array, ...]]:
        """Scores and offsets of each view."""
        return [head(x, train) for head, x in zip(self.rpn, crops, strict=True)]

    def second_stage(self, crops: tuple[Array, Array], train: bool) -> list[tuple[Array, ...]]:
        """Class scores, corner offsets and angle vector of each view."""
        return [head(x, train) for head, x in zip(self.second, crops, strict=True)]

    def __call__(self, first: tuple[Array, Array], second: tuple[Array, Array]) -> None:
        """Touch every parameter once (for `init`)."""
        self.first_stage(first, False)
        if self.config.auxiliary_second:
            self.second_stage(second, False)


def crop_views(
    maps: tuple[Array, Array], boxes: tuple[Array, Array], size: int
) -> tuple[Array, Array]:
    """Crops `[b, n, size, size, c]` of both views' maps at their boxes `[b, n, 4]`."""
    crop = jax.vmap(lambda m, b: crop_and_resize(m, b, (size, size)))
    return crop(maps[0], boxes[0]), crop(maps[1], boxes[1])


def fuse(crops: tuple[Array, Array], scale: Float[Array, "b 2"]) -> Array:
    r"""Mean of the scaled crops, :math:`\frac{1}{2} \sum_k s_k x_k`.

    The scale is 2 w, so that equal weights are AVOD's mean; times the path drop's factor in
    training.
    """
    factor = 0.5 * scale[:, :, None, None, None, None]
    return factor[:, 0] * crops[0] + factor[:, 1] * crops[1]


def init_avod(key: PRNGKeyArray, config: DetectorConfig) -> tuple[Any, Any]:
    """Fresh parameters and the statistics of batch norm (empty with group norm).

    Parameters are `main` and, for `avod_argate`, those that training alone needs: `auxiliary`
    (the paths of the views), `targets` (the lattice), `mean_losses` (of the paths).
    """
    main_key, aux_key, target_key = jax.random.split(key, 3)

    def shape(*sides: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, *sides), jnp.float32)

    image, bev = shape(*config.image_size, 3), shape(*config.bev.shape, config.bev.n_slices + 1)
    variables = init_weights(main_key, Detector(config), image, bev, scales=_OUTPUTS)
    params: dict[str, Any] = {"main": variables["params"]}
    if config.gated:
        first = shape(config.rpn_crop, config.rpn_crop, 1)
        second = shape(config.second_crop, config.second_crop, config.widths[0])
        heads = init_weights(
            aux_key, AuxiliaryHeads(config), (first, first), (second, second), scales=_OUTPUTS
        )
        params["auxiliary"] = heads["params"]
        params["targets"] = init_targets(target_key, config.targets, 2)
        params["mean_losses"] = jnp.full(2, math.log(2.0), jnp.float32)
    return params, variables.get("batch_stats", {})
