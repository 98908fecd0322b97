"""Kinds of sensor failure that are left out of a detector's training together."""

FOLDS = (
    ("camera_noise", "camera_fog", "lidar_loss"),
    ("camera_blackout", "lidar_noise", "lidar_sector_dropout"),
    ("camera_blur", "camera_exposure", "lidar_beam_loss"),
)
"""Thirds of `SENSOR_FAILURES`; each has both sensors."""
