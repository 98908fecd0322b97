"""Car detection on KITTI: files, geometry, AVOD and AVOD-ARGate, average precision.

What most users need is listed here. The rooms have the rest: `kitti` (files, calibration, the
official score), `geometry`, `sensors` (how they fail), `network`, `learning`, `simulator`; pictures
are in `fusion.detection.plots`, which is imported on its own.
"""

from fusion.detection.config import DetectorConfig
from fusion.detection.kitti import evaluate, read_frame
from fusion.detection.learning import (
    DetectorParams,
    DetectorTrainConfig,
    fit_detector,
    make_example,
    run_detector,
)
from fusion.detection.presets import preset
from fusion.detection.sensors import camera_failure, lidar_failure

__all__ = [
    "DetectorConfig",
    "DetectorParams",
    "DetectorTrainConfig",
    "camera_failure",
    "evaluate",
    "fit_detector",
    "lidar_failure",
    "make_example",
    "preset",
    "read_frame",
    "run_detector",
]
