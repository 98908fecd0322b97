"""What camera and lidar read, and how each of them fails."""

from fusion.detection.sensors.camera_failures import (
    CAMERA_FAILURES,
    camera_failure,
    random_camera_failure,
)
from fusion.detection.sensors.hdl64 import beam_of
from fusion.detection.sensors.lidar_failures import (
    LIDAR_FAILURES,
    lidar_failure,
    random_lidar_failure,
)

__all__ = [
    "CAMERA_FAILURES",
    "LIDAR_FAILURES",
    "beam_of",
    "camera_failure",
    "lidar_failure",
    "random_camera_failure",
    "random_lidar_failure",
]
