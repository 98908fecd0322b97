"""Sets of sizes and rates that fit together: `paper`, `small` and `tiny`."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple, cast, get_args

from fusion.detection.config import CAR_SIZES, DETECTORS, DenseConfig, DetectorConfig, DetectorModel
from fusion.detection.geometry.anchors import AnchorConfig
from fusion.detection.geometry.bev import BevConfig
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.training import DetectorTrainConfig

Size = Literal["paper", "small", "tiny"]
SIZES: tuple[str, ...] = get_args(Size)


class DetectorSetup(NamedTuple):
    """A detector, how it is trained, and the numbers that a sweep may vary."""

    config: DetectorConfig
    train: DetectorTrainConfig
    params: DetectorParams


def _small(base: DetectorConfig) -> DetectorConfig:
    return dataclasses.replace(
        base,
        bev=BevConfig(x_range=(-22.0, 22.0), z_range=(2.0, 46.0), cell=0.25),
        anchors=AnchorConfig(CAR_SIZES, max_anchors=12_288),
        image_size=(96, 320),
        max_points=20_480,
        max_objects=16,
        widths=(8, 16, 32, 64),
        norm="group",
        rpn_width=64,
        fc_widths=(512, 512),
        gate_width=16,
        dropout=0.1,
        path_drop=0.3,
        rpn_batch=128,
        candidates=512,
        proposals_train=128,
        proposals=64,
        second_batch=128,
        truth_proposals=16,
        max_detections=32,
        score_threshold=0.02,
        regression_weight=2.0,
    )


def _tiny(base: DetectorConfig) -> DetectorConfig:
    return dataclasses.replace(
        base,
        bev=BevConfig(x_range=(-8.0, 8.0), z_range=(4.0, 20.0), cell=0.5),
        anchors=AnchorConfig(CAR_SIZES[1:], stride=1.0, max_anchors=128),
        image_size=(16, 48),
        max_points=1024,
        max_objects=4,
        widths=(4, 8),
        layers=(1, 1),
        norm="group",
        rpn_width=8,
        fc_widths=(16,),
        second_crop=3,
        gate_width=4,
        dropout=0.0,
        rpn_batch=16,
        candidates=32,
        proposals_train=16,
        proposals=8,
        second_batch=8,
        truth_proposals=2,
        max_detections=4,
        score_threshold=0.0,
    )


def _dense(size: str, made: DetectorSetup) -> DetectorSetup:
    """The one-stage detector's widths, losses and schedule."""
    config, train, rates = made
    if size == "paper":
        dense = DenseConfig(lidar_width=64, camera_widths=(32, 64), trunk_widths=(64, 128))
    elif size == "small":
        dense = DenseConfig()
        train = dataclasses.replace(train, steps=6000, batch_size=2)
    else:
        dense = DenseConfig(lidar_width=8, camera_widths=(4, 8), trunk_widths=(8, 8), candidates=16)
    # Path drop: AVOD's own; with 0.3, half of the frames lack a view that works. Views that the
    # auxiliary losses train as well are worse ones for the trunk (docs/kitti.md has both).
    config = dataclasses.replace(
        config, dense=dense, regression_weight=1.0, norm="group", path_drop=0.1,
        auxiliary_trains_views=False,
    )  # fmt: skip
    return DetectorSetup(config, train, rates._replace(clip_norm=5.0))


def preset(size: str, model: str = "avod_argate") -> DetectorSetup:
    """A detector of a size, and its training.

    Args:
        size: `paper`, AVOD's sizes and rates; `small`, 0.25 m cells over 44 x 44 m, images at a
            quarter of the side and a quarter of the width, 2,000 steps, for two CPU cores; `tiny`,
            for tests.
        model: one of `DETECTORS`.

    Returns:
        DetectorSetup: config, train, params.

    Raises:
        ValueError: unknown size or model.

    Example:
        >>> setup = preset("small", "avod")
        >>> setup.train.steps, setup.params.learning_rate
        (2000, 0.002)
    """
    if model not in DETECTORS:
        raise ValueError(f"model={model!r}: expected one of {', '.join(DETECTORS)}")
    named = cast(DetectorModel, model)
    if model.startswith("dense"):
        twin = preset(size, "avod" if model == "dense" else "avod_argate")
        made = twin._replace(config=dataclasses.replace(twin.config, model=named))
        return _dense(size, made)
    base = DetectorConfig(model=named)
    rates = DetectorParams()
    if size == "paper":
        return DetectorSetup(base, DetectorTrainConfig(), rates)
    if size == "small":
        train = DetectorTrainConfig(steps=2000, schedule="cosine")
        rates = rates._replace(learning_rate=2e-3, l2=1e-5, l2_dense=1e-5)
        return DetectorSetup(_small(base), train, rates)
    if size == "tiny":
        train = DetectorTrainConfig(steps=20, schedule="cosine")
        rates = rates._replace(learning_rate=3e-3, l2=0.0, l2_dense=0.0)
        return DetectorSetup(_tiny(base), train, rates)
    raise ValueError(f"size={size!r}: expected one of {', '.join(SIZES)}")
