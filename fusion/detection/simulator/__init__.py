"""Simulated KITTI frames: layouts, scenes, both sensors rendered in JAX, labels."""

from fusion.detection.simulator.labels import Visibility, labels_of, visibility_of
from fusion.detection.simulator.layouts import (
    Layout,
    compose,
    generated_layout,
    read_layouts,
)
from fusion.detection.simulator.rendering import (
    SIZES,
    Rays,
    Readings,
    SensorConfig,
    nominal_calibration,
    rays,
    render,
)
from fusion.detection.simulator.scene import KINDS, LABELLED, Scene, SceneConfig, build_scene

__all__ = [
    "KINDS",
    "LABELLED",
    "SIZES",
    "Layout",
    "Rays",
    "Readings",
    "Scene",
    "SceneConfig",
    "SensorConfig",
    "Visibility",
    "build_scene",
    "compose",
    "generated_layout",
    "labels_of",
    "nominal_calibration",
    "rays",
    "read_layouts",
    "render",
    "visibility_of",
]
