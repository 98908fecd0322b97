"""KITTI files, calibration, objects and the official average precision."""

__all__: list[str] = []
