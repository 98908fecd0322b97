"""What camera and lidar read, how each of them fails, and what tells."""

from fusion.detection.sensors.beams import beams_of_scans, elevations_of, find_beams
from fusion.detection.sensors.camera_failures import (
    CAMERA_FAILURES,
    CameraFailure,
    camera_failure,
    random_camera_failure,
)
from fusion.detection.sensors.depth import FARTHEST, depth_image
from fusion.detection.sensors.deviation import Clean, deviations, fit_clean
from fusion.detection.sensors.hdl64 import AZIMUTH_STEP, ELEVATIONS, N_BEAMS, RANGE_NOISE, beam_of
from fusion.detection.sensors.lidar_failures import (
    LIDAR_FAILURES,
    LidarFailure,
    lidar_failure,
    random_lidar_failure,
)
from fusion.detection.sensors.misalignment import MISALIGNMENTS, Misalignment, misaligned
from fusion.detection.sensors.platt import (
    AS_TOLD,
    Calibration,
    alarm_threshold,
    fit_platt,
    frames_needed,
    rescaled,
)
from fusion.detection.sensors.quality import (
    N_IMAGE,
    N_SCAN,
    image_statistics,
    quality_statistics,
    scan_statistics,
)
from fusion.detection.sensors.severity import Severity, check_failure

__all__ = [
    "AS_TOLD",
    "AZIMUTH_STEP",
    "CAMERA_FAILURES",
    "ELEVATIONS",
    "FARTHEST",
    "LIDAR_FAILURES",
    "MISALIGNMENTS",
    "N_BEAMS",
    "N_IMAGE",
    "N_SCAN",
    "RANGE_NOISE",
    "Calibration",
    "CameraFailure",
    "Clean",
    "LidarFailure",
    "Misalignment",
    "Severity",
    "alarm_threshold",
    "beam_of",
    "beams_of_scans",
    "camera_failure",
    "check_failure",
    "depth_image",
    "deviations",
    "elevations_of",
    "find_beams",
    "fit_clean",
    "fit_platt",
    "frames_needed",
    "image_statistics",
    "lidar_failure",
    "misaligned",
    "quality_statistics",
    "random_camera_failure",
    "random_lidar_failure",
    "rescaled",
    "scan_statistics",
]
