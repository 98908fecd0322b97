"""Frames of one simulated scene that the car drives through."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

from fusion.detection.geometry.planes import plane_y
from fusion.detection.simulator.frames import SimulatedFrame, draw_scene
from fusion.detection.simulator.labels import visibility_of
from fusion.detection.simulator.rendering import (
    Readings,
    SensorConfig,
    nominal_calibration,
    rays,
    render,
)
from fusion.detection.simulator.scene import Scene, SceneConfig


def approach(scene: Scene, distance: float) -> Scene:
    """The scene from a place that lies `distance` [m] ahead on a straight way; all else stands."""
    place = scene.place - np.array([0.0, 0.0, distance], np.float32)
    place[:, 1] = plane_y(scene.plane, place[:, 0], place[:, 2])
    return scene._replace(place=place)


def drive_frames(
    scene_config: SceneConfig,
    sensor_config: SensorConfig,
    n_frames: int,
    *,
    seed: int,
    speed: float = 4.0,
    period: float = 0.1,
) -> Iterator[SimulatedFrame]:
    """Frames of a straight drive through one scene, in their order.

    Args:
        scene_config, sensor_config: as for `simulate_frames`.
        n_frames: how many.
        seed: of scene and noise.
        speed: of the car [m/s].
        period: between frames [s].

    Raises:
        ValueError: no frame, or a way so long that it leaves the scene behind.
    """
    way = speed * period * (n_frames - 1)
    if n_frames < 1 or not 0.0 <= way <= 30.0:
        raise ValueError(
            f"n_frames={n_frames}, speed={speed}, period={period}: expected at least one frame and "
            f"a way of 0 to 30 m, not {way:.1f}"
        )
    beams = rays(sensor_config, nominal_calibration(sensor_config.scale))
    scene, n_things = draw_scene(scene_config, 0, 0, (), seed=seed)
    root = jax.random.key(seed)
    for i in range(n_frames):
        here = approach(scene, speed * period * i)
        one = jax.tree.map(lambda leaf: leaf[None], here)
        read = jax.device_get(
            render(sensor_config, one, beams, keys=jax.random.fold_in(root, i)[None])
        )
        readings = Readings(*(leaf[0] for leaf in read))
        seen = visibility_of(here, readings, n_things)
        yield SimulatedFrame(i, here, readings, seen, bool(scene.light[1] < 0.5))
