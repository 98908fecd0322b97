"""Sizes and choices of the detectors; `fusion.detection.presets` has sets of them."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from fusion.detection.geometry.anchors import AnchorConfig
from fusion.detection.geometry.bev import BevConfig
from fusion.detection.sensors.hdl64 import ELEVATIONS
from fusion.gating import Normalizer
from fusion.losses import LossConfig
from fusion.targets import TargetConfig

DetectorModel = Literal["avod", "avod_argate", "dense", "dense_argate", "dense_oracle"]
DETECTORS: tuple[str, ...] = get_args(DetectorModel)

Precision = Literal["float32", "bfloat16"]
Overlap = Literal["upright", "rotated"]
Target = Literal["Car", "Pedestrian", "Cyclist"]
TARGETS: tuple[str, ...] = get_args(Target)
# k-means of the 14,357, 2,207 and 734 labels of the usual training list: length, width, height [m].
CAR_SIZES = ((3.513, 1.581, 1.511), (4.234, 1.653, 1.546))
TARGET_SIZES = {
    "Car": CAR_SIZES,
    "Pedestrian": ((0.582, 0.624, 1.721), (1.0, 0.631, 1.804)),
    "Cyclist": ((1.659, 0.484, 1.687), (1.889, 0.661, 1.761)),
}


@dataclasses.dataclass(frozen=True)
class DenseConfig:
    """Sizes of the one-stage detector on a grid over the ground.

    Attributes:
        cell: side of a cell of the grid [m], a multiple of the map's.
        lidar_width: channels of the lidar's grid; camera_widths: of the camera's maps at half and
            at a quarter of the image's resolution; trunk_widths: at the grid's resolution and
            below it.
        heights: above ground at which a cell samples the camera's map [m].
        heat_sd, radius: deviation of the heat around a car's centre, and how near to it cells tell
            its box [m].
        overlap_weight: of the loss by overlap of boxes beside that of their numbers.
        nms, candidates: rotated overlap limit between detections, and of how many.
    """

    cell: float = 0.5
    lidar_width: int = 32
    camera_widths: tuple[int, int] = (16, 32)
    trunk_widths: tuple[int, int] = (32, 64)
    heights: tuple[float, ...] = (0.4, 1.0, 1.6)
    heat_sd: float = 0.45
    radius: float = 0.9
    overlap_weight: float = 2.0
    nms: float = 0.1
    candidates: int = 64

    def __post_init__(self) -> None:
        """Check widths and lengths."""
        widths = (self.lidar_width, *self.camera_widths, *self.trunk_widths)
        if any(width < 4 or width % 4 for width in widths):
            raise ValueError(f"dense widths={widths}: expected multiples of 4, for group norm")
        for name in ("cell", "heat_sd", "radius"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)}: expected a length above 0 [m]")
        if not 0 <= self.overlap_weight < float("inf"):
            raise ValueError(f"overlap_weight={self.overlap_weight}: expected a number >= 0")
        if not self.heights or not 0 <= self.nms <= 1 or self.candidates < 1:
            raise ValueError(
                f"heights={self.heights}, nms={self.nms}, candidates={self.candidates}: expected "
                "at least one height and candidate, and a share"
            )


@dataclasses.dataclass(frozen=True)
class DetectorConfig:
    """Everything static of the detector; the defaults are AVOD's.

    Attributes:
        model: `avod` (mean fusion) or `avod_argate` (fusion weights), in two stages; `dense` or
            `dense_argate`, in one stage on a grid over the ground; `dense_oracle`, whose gate is
            told which sensor fails and how severely.
        target: the class that is told from the background; set by the cache, like the anchor sizes.
        dense: sizes of the latter three, which share with AVOD what is about area, image, labels,
            gate and paths.
        fixed_weights: of (camera, lidar), in place of the network's; `dense` models only. (1, 0)
            leaves a detector of the camera alone.
        bev, anchors: area and anchor grid.
        image_size: rows and columns that images are resized to.
        beams: elevations of the lidar's beams from the top one down [degree], which `beam_loss`
            loses; None for those of the HDL-64E, empty where they are not known.
        max_points, max_objects: fixed sizes of scan and labels.
        widths: channels of the encoder's four levels; layers: convolutions on each.
        precision: of the convolutions, `float32` or `bfloat16`, for accelerators; parameters,
            normalization, heads and losses are float32 in any case.
        norm: `batch` or `group`; with one frame a batch, group norm is the steadier one.
        rpn_width, rpn_crop: units of the first stage's two towers, side of its crops.
        fc_widths, second_crop: fully connected layers of the second stage, side of its crops.
        gate_width: hidden units of the gate; normalizer: of the fusion weights.
        gate_statistics: the gate tells from statistics of the raw picture and map how probably each
            sensor has failed, and reads that beside the feature maps.
        dropout: in both stages' heads; path_drop: probability to drop a view in training.
        rpn_batch, rpn_iou: mini-batch of anchors; ground overlap below which an anchor is negative
            and from which it is positive.
        rpn_nms, candidates, proposals_train, proposals: overlap limit between proposals, how many
            are looked at, how many are kept.
        second_batch, second_iou: likewise of the second stage.
        truth_proposals: shifted copies of each label among the training proposals (0 in AVOD).
        final_nms, max_detections, score_threshold: of the result.
        final_overlap: what `final_nms` limits in the two-stage models: `upright`, the overlap of
            the smallest upright rectangles on the ground, as in AVOD, or `rotated`, that of the
            boxes' own; `dense` models always take the latter.
        label_smoothing, regression_weight, angle_weight: of the losses.
        gate_loss, targets: terms of Equation 3.2, see `fusion.losses`.
        auxiliary_second: the auxiliary paths of the views go on through the second stage.
        auxiliary_trains_views: the auxiliary losses train the views beside their own heads, as in
            the source; `dense` models can do without.
        balanced_paths: the class losses of these paths weigh positives and negatives alike, and
            the targets see how far their mean lies above its running mean for the view, in frames
            with positives; else class losses are means over the mini-batch and the targets see the
            whole losses of the paths.

    Raises:
        ValueError: what cannot be built, by name and value.

    Example:
        >>> DetectorConfig(model="avod").rpn_crop
        3
    """

    model: DetectorModel = "avod_argate"
    target: Target = "Car"
    dense: DenseConfig = dataclasses.field(default_factory=DenseConfig)
    bev: BevConfig = dataclasses.field(default_factory=BevConfig)
    anchors: AnchorConfig = dataclasses.field(default_factory=lambda: AnchorConfig(CAR_SIZES))
    image_size: tuple[int, int] = (360, 1200)
    beams: tuple[float, ...] | None = None
    max_points: int = 32_768
    max_objects: int = 32
    widths: tuple[int, ...] = (32, 64, 128, 256)
    layers: tuple[int, ...] = (2, 2, 3, 3)
    precision: Precision = "float32"
    norm: Literal["batch", "group"] = "batch"
    rpn_width: int = 256
    rpn_crop: int = 3
    fc_widths: tuple[int, ...] = (2048, 2048, 2048)
    second_crop: int = 7
    gate_width: int = 32
    normalizer: Normalizer = "softmax"
    gate_statistics: bool = True
    dropout: float = 0.5
    path_drop: float = 0.1
    rpn_batch: int = 512
    rpn_iou: tuple[float, float] = (0.3, 0.5)
    rpn_nms: float = 0.8
    candidates: int = 4096
    proposals_train: int = 1024
    proposals: int = 300
    second_batch: int = 1024
    second_iou: tuple[float, float] = (0.55, 0.65)
    truth_proposals: int = 0
    final_nms: float = 0.01
    final_overlap: Overlap = "upright"
    max_detections: int = 100
    score_threshold: float = 0.1
    label_smoothing: float = 0.001
    regression_weight: float = 5.0
    angle_weight: float = 1.0
    gate_loss: LossConfig = dataclasses.field(default_factory=lambda: LossConfig(uniform_floor=1.0))
    targets: TargetConfig = dataclasses.field(
        default_factory=lambda: TargetConfig(loss_range=(0.0, 2.0))
    )
    auxiliary_second: bool = True
    auxiliary_trains_views: bool = True
    balanced_paths: bool = True
    fixed_weights: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        if self.model not in DETECTORS:
            raise ValueError(f"model={self.model!r}: expected one of {', '.join(DETECTORS)}")
        if self.target not in TARGETS:
            raise ValueError(f"target={self.target!r}: expected one of {', '.join(TARGETS)}")
        if self.norm not in ("batch", "group"):
            raise ValueError(f"norm={self.norm!r}: expected 'batch' or 'group'")
        if self.beams and not (
            all(a > b for a, b in itertools.pairwise(self.beams))
            and 90 > self.beams[0] > self.beams[-1] > -90
        ):
            raise ValueError(
                f"beams={self.beams}: expected elevations [degree] from the top beam down, each "
                "once; give at least two"
            )
        if self.precision not in get_args(Precision):
            raise ValueError(f"precision={self.precision!r}: expected 'float32' or 'bfloat16'")
        if self.final_overlap not in get_args(Overlap):
            raise ValueError(
                f"final_overlap={self.final_overlap!r}: expected 'upright' or 'rotated'"
            )
        if self.normalizer not in get_args(Normalizer):
            raise ValueError(
                f"normalizer={self.normalizer!r}: expected one of {', '.join(get_args(Normalizer))}"
            )
        if len(self.widths) != len(self.layers) or min(self.layers) < 1:
            raise ValueError(
                f"widths={self.widths}, layers={self.layers}: expected one positive number of "
                "layers for each width"
            )
        if self.norm == "group" and any(width % 4 for width in self.widths):
            raise ValueError(f"widths={self.widths}: group norm needs multiples of 4")
        for name in ("rpn_iou", "second_iou"):
            low, high = getattr(self, name)
            if not 0 <= low <= high < 1:
                raise ValueError(
                    f"{name}={(low, high)}: expected the negative limit, then the positive, in "
                    "[0, 1)"
                )
        stride = self.dense.cell / self.bev.cell
        if self.is_dense and (
            abs(stride - round(stride)) > 1e-6 or any(n % round(stride) for n in self.bev.shape)
        ):
            raise ValueError(
                f"cell={self.dense.cell}: expected a multiple of the map's {self.bev.cell} m that "
                f"divides its {self.bev.shape[0]} x {self.bev.shape[1]} cells"
            )
        if self.fixed_weights is not None and not self.is_dense:
            raise ValueError(
                f"fixed_weights={self.fixed_weights}: expected none with model={self.model!r}; the "
                "dense models can do without a sensor"
            )
        if not (self.auxiliary_trains_views or self.is_dense):
            raise ValueError(
                f"auxiliary_trains_views=False: expected True with model={self.model!r}; the dense "
                "models can do without"
            )
        for name in ("dropout", "path_drop"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected a share in [0, 1)")

    @property
    def gated(self) -> bool:
        """Has the model a gate, auxiliary paths and targets?"""
        return self.model.endswith("_argate")

    @property
    def is_oracle(self) -> bool:
        """Is its gate told which sensor fails?"""
        return self.model == "dense_oracle"

    @property
    def weighs(self) -> bool:
        """Do its fusion weights depend on the frame?"""
        return self.gated or self.is_oracle

    @property
    def is_dense(self) -> bool:
        """Is it the one-stage detector?"""
        return self.model.startswith("dense")

    @property
    def beam_elevations(self) -> Float[np.ndarray, " b"]:
        """Elevations of the lidar's beams from the top one down [rad]."""
        return ELEVATIONS if self.beams is None else np.radians(self.beams).astype(np.float32)
