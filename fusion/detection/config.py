"""Sizes and choices of the two-stage detector; `fusion.detection.presets` has sets of them."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

from fusion.detection.geometry.anchors import AnchorConfig
from fusion.detection.geometry.bev import BevConfig
from fusion.gating import Normalizer
from fusion.losses import LossConfig
from fusion.targets import TargetConfig

__all__ = ["CAR_SIZES", "DETECTORS", "DetectorConfig", "DetectorModel"]

DetectorModel = Literal["avod", "avod_argate"]
DETECTORS: tuple[str, ...] = get_args(DetectorModel)

# k-means of the 14,357 labelled cars of the usual training list: length, width, height [m].
CAR_SIZES = ((3.513, 1.581, 1.511), (4.234, 1.653, 1.546))


@dataclasses.dataclass(frozen=True)
class DetectorConfig:
    """Everything static of the detector; the defaults are AVOD's.

    Attributes:
        model: `avod` (mean fusion) or `avod_argate` (fusion weights).
        bev, anchors: area and anchor grid.
        image_size: rows and columns that images are resized to.
        max_points, max_objects: fixed sizes of scan and labels.
        widths: channels of the encoder's four levels; layers: convolutions on each.
        norm: `batch` or `group`; with one frame a batch, group norm is the steadier one.
        rpn_width, rpn_crop: units of the first stage's two towers, side of its crops.
        fc_widths, second_crop: fully connected layers of the second stage, side of its crops.
        gate_width: hidden units of the gate; normalizer: of the fusion weights.
        dropout: in both stages' heads; path_drop: probability to drop a view in training.
        rpn_batch, rpn_iou: mini-batch of anchors; ground overlap below which an anchor is negative
            and from which it is positive.
        rpn_nms, candidates, proposals_train, proposals: overlap limit between proposals, how many
            are looked at, how many are kept.
        second_batch, second_iou: likewise of the second stage.
        truth_proposals: shifted copies of each label among the training proposals (0 in AVOD).
        final_nms, max_detections, score_threshold: of the result.
        label_smoothing, regression_weight, angle_weight: of the losses.
        gate_loss, targets: terms of Equation 3.2, see `fusion.losses`.
        auxiliary_second: the auxiliary paths of the views go on through the second stage.
        balanced_paths: the class losses of these paths weigh positives and negatives alike, and
            the targets see how far their mean lies above its running mean for the view, in frames
            with positives; else class losses are means over the mini-batch and the targets see the
            whole losses of the paths.
    """

    model: DetectorModel = "avod_argate"
    bev: BevConfig = dataclasses.field(default_factory=BevConfig)
    anchors: AnchorConfig = dataclasses.field(default_factory=lambda: AnchorConfig(CAR_SIZES))
    image_size: tuple[int, int] = (360, 1200)
    max_points: int = 32_768
    max_objects: int = 32
    widths: tuple[int, ...] = (32, 64, 128, 256)
    layers: tuple[int, ...] = (2, 2, 3, 3)
    norm: Literal["batch", "group"] = "batch"
    rpn_width: int = 256
    rpn_crop: int = 3
    fc_widths: tuple[int, ...] = (2048, 2048, 2048)
    second_crop: int = 7
    gate_width: int = 32
    normalizer: Normalizer = "softmax"
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
    balanced_paths: bool = True

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        if self.model not in DETECTORS:
            raise ValueError(f"model={self.model!r}: expected one of {', '.join(DETECTORS)}")
        if self.norm not in ("batch", "group"):
            raise ValueError(f"norm={self.norm!r}: expected 'batch' or 'group'")
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
        for name in ("dropout", "path_drop"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected a share in [0, 1)")
