r"""Camera and lidar of a simulated scene: rays, returns, noise; jitted over many frames.

The camera averages several rays a pixel. The lidar sends one ray a shot and hears it when the light
that comes back,

.. math:: P = \rho \, \frac{0.77 \cos\theta + 0.34 \sin^2\theta}{r^2}, \qquad
    \Pr(\text{return}) = \frac{1}{1 + (P_0 / P)^4},

is above its threshold: :math:`\rho` is the reflectivity, :math:`\theta` the angle of incidence,
:math:`r` the range, and :math:`P_0` the light of a 10 % target at 50 m. Dark paint is thus lost
beyond some 25 m and road beyond some 40 m. Glass returns little.

Source: Oren, Nayar (1994), rough surface (sigma = 30 degrees) lit from where it is seen; Velodyne,
HDL-64E data sheet, for the pattern, the 10 % target, and the range noise. The softness of the
threshold (power 4), the drop-outs and the share of returns from glass are our choice.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray

from fusion.detection.kitti.calibration import Calibration, camera_to_lidar, lidar_to_camera
from fusion.detection.sensors.hdl64 import AZIMUTH_STEP, ELEVATIONS, RANGE_NOISE
from fusion.detection.simulator.materials import surfaces
from fusion.detection.simulator.raycast import cast
from fusion.detection.simulator.scene import Scene

DIFFUSE, RETRO = 0.773, 0.339  # Oren-Nayar A and B at a roughness of 30 degrees
THRESHOLD = 0.1 * DIFFUSE / 50.0**2
GLASS_SHARE = 0.25
DROP_SHARE = 0.05
FULL_WIDTH, FULL_HEIGHT = 1242, 375


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """Sizes of the readings (static: each makes a program of its own).

    Attributes:
        width, height: of the image [pixel]; its scale is width / 1242.
        rays_per_side: rays a pixel in each direction.
        azimuth_steps: how many of the HDL-64's shots one simulated shot stands for.
        azimuth_half: the scan covers this angle to both sides of straight ahead [degree].
        max_range, min_range: of the lidar [m].
        pixel_noise: sd of a pixel in [0, 1].
    """

    width: int = FULL_WIDTH
    height: int = FULL_HEIGHT
    rays_per_side: int = 1
    azimuth_steps: int = 1
    azimuth_half: float = 45.0
    max_range: float = 120.0
    min_range: float = 0.9
    pixel_noise: float = 0.012

    def __post_init__(self) -> None:
        """Check sizes and ranges."""
        for name in ("width", "height", "rays_per_side", "azimuth_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")
        if not (0.0 < self.azimuth_half <= 180.0 and 0.0 <= self.min_range < self.max_range):
            raise ValueError(
                f"azimuth_half={self.azimuth_half}, min_range={self.min_range}, max_range="
                f"{self.max_range}: expected 0 to 180 degrees and 0 <= min_range < max_range"
            )

    @property
    def scale(self) -> float:
        """Width of the image over that of the benchmark."""
        return self.width / FULL_WIDTH


SIZES = {
    "tiny": SensorConfig(width=192, height=58, azimuth_steps=4),
    "small": SensorConfig(width=320, height=96, rays_per_side=2, azimuth_steps=3),
    "paper": SensorConfig(),
}


class Rays(NamedTuple):
    """Where the rays start `[3]` and go, in the camera frame, and lidar directions as measured.

    `camera` is `[H s W s, 3]` with s rays per side and has depth 1 in the projection; `lidar` and
    `lidar_own` are `[64 A, 3]` unit vectors in the camera and in the lidar frame.
    """

    camera_origin: np.ndarray
    camera: np.ndarray
    lidar_origin: np.ndarray
    lidar: np.ndarray
    lidar_own: np.ndarray


class Readings(NamedTuple):
    """What the sensors read in one frame, and what is known about it.

    `image` `[H, W, 3]` in [0, 1]; `depth` `[H, W]` of the nearest ray of each pixel [m], inf for
    sky; `owner` `[H, W]` slot of what that ray met (-1 ground, -2 sky); `points` `[64 A, 4]`
    x, y, z in the lidar frame and reflectance; `mask` `[64 A]`; `point_owner` `[64 A]`; `visible`
    and `alone` `[K]` pixels of each body as it is, and if nothing stood before it.
    """

    image: Array
    depth: Array
    owner: Array
    points: Array
    mask: Array
    point_owner: Array
    visible: Array
    alone: Array


def nominal_calibration(scale: float = 1.0) -> Calibration:
    """A calibration like the benchmark's, for an image resized by `scale`.

    Pixel (i, j) covers j to j + 1 and i to i + 1, so a resized image needs only the first two rows
    of its projections multiplied by `scale`.
    """
    if not scale > 0.0:
        raise ValueError(f"scale is {scale}, expected above 0")
    focal, centre = 721.5, (609.6, 172.9)
    # Baselines of the four cameras to camera 0 [m].
    offsets = np.array(
        [[0.0, 0.0, 0.0], [-0.537, 0, 0], [0.060, 0.0, 0.003], [-0.472, 0.003, 0.003]]
    )
    k = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    k[:2] *= scale
    projections = np.stack([np.column_stack([k, k @ t]) for t in offsets])

    def turn(i: int, j: int, degrees: float) -> np.ndarray:
        r, angle = np.eye(3), np.radians(degrees)
        r[[i, j, i, j], [i, j, j, i]] = [np.cos(angle)] * 2 + [-np.sin(angle), np.sin(angle)]
        return r

    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    velo = np.column_stack([turn(1, 2, -0.5) @ turn(0, 2, 0.3) @ axes, [-0.004, -0.076, -0.272]])
    return Calibration(projections, turn(0, 1, 0.5) @ turn(1, 2, 0.2), velo, np.eye(3, 4))


def rays(config: SensorConfig, calibration: Calibration) -> Rays:
    """The rays of both sensors; the same for all frames of one calibration."""
    s = config.rays_per_side
    v, u = np.meshgrid(
        (np.arange(config.height * s) + 0.5) / s, (np.arange(config.width * s) + 0.5) / s,
        indexing="ij",
    )  # fmt: skip
    m, t = calibration.p2[:, :3], calibration.p2[:, 3]
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    step = AZIMUTH_STEP * config.azimuth_steps
    n = int(np.radians(config.azimuth_half) / step)
    elevation, azimuth = np.meshgrid(ELEVATIONS, np.arange(-n, n + 1) * step, indexing="ij")
    own = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    origin = lidar_to_camera(calibration, np.zeros((1, 3)))[0]
    found = Rays(
        camera_origin=-np.linalg.solve(m, t),
        camera=np.linalg.solve(m, pixels.T).T,
        lidar_origin=origin,
        lidar=lidar_to_camera(calibration, own) - origin,
        lidar_own=camera_to_lidar(calibration, lidar_to_camera(calibration, own)),
    )
    return Rays(*(a.astype(np.float32) for a in found))


def _camera(
    config: SensorConfig, scene: Scene, beams: Rays, key: PRNGKeyArray
) -> tuple[Array, ...]:
    origin, directions = jnp.asarray(beams.camera_origin), jnp.asarray(beams.camera)
    hits = cast(scene, origin, directions)
    colour = surfaces(scene, hits, origin, directions).colour * scene.light[1]
    s, h, w = config.rays_per_side, config.height, config.width

    def blocks(values: Array) -> Array:
        tail = values.shape[1:]
        grid = values.reshape(h, s, w, s, *tail).swapaxes(1, 2)
        return grid.reshape(h, w, s * s, *tail)

    image = blocks(colour).mean(axis=2)
    image = image + config.pixel_noise * jax.random.normal(key, image.shape)
    distance = blocks(hits.distance)  # in depths: directions have depth 1
    nearest = distance.argmin(axis=2, keepdims=True)
    depth = jnp.take_along_axis(distance, nearest, axis=2)[..., 0]
    owner = jnp.take_along_axis(blocks(hits.body), nearest, axis=2)[..., 0]
    seen = jax.ops.segment_sum(
        (hits.body >= 0).astype(jnp.int32), jnp.maximum(hits.body, 0), scene.place.shape[0]
    )
    per_pixel = 1.0 / (s * s)
    visible, alone = (x.astype(jnp.float32) * per_pixel for x in (seen, hits.alone))
    return jnp.clip(image, 0.0, 1.0), depth, owner, visible, alone


def _lidar(config: SensorConfig, scene: Scene, beams: Rays, key: PRNGKeyArray) -> tuple[Array, ...]:
    origin, directions = jnp.asarray(beams.lidar_origin), jnp.asarray(beams.lidar)
    hits = cast(scene, origin, directions)
    surface = surfaces(scene, hits, origin, directions)
    cos = jnp.clip(-jnp.sum(hits.normal * directions, axis=1), 0.0, 1.0)
    bright = surface.reflectivity * (DIFFUSE * cos + RETRO * (1.0 - cos**2))
    light = bright / jnp.maximum(hits.distance, config.min_range) ** 2
    chance = 1.0 / (1.0 + (THRESHOLD / jnp.maximum(light, 1e-12)) ** 4)
    chance = chance * (1.0 - DROP_SHARE) * jnp.where(surface.glass, GLASS_SHARE, 1.0)
    by_return, by_range, by_light = jax.random.split(key, 3)
    n = hits.distance.shape
    heard = jax.random.uniform(by_return, n) < chance
    heard &= (hits.distance > config.min_range) & (hits.distance < config.max_range)
    measured = hits.distance + RANGE_NOISE * jax.random.normal(by_range, n)
    reflectance = bright * (1.0 + 0.1 * jax.random.normal(by_light, n))
    place = jnp.where(heard, measured, 0.0)[:, None] * beams.lidar_own
    points = jnp.concatenate([place, jnp.clip(reflectance, 0.0, 1.0)[:, None]], axis=1)
    return jnp.where(heard[:, None], points, 0.0), heard, jnp.where(heard, hits.body, -2)


@partial(jax.jit, static_argnames=("config", "batch_size"))
def render(
    config: SensorConfig,
    scenes: Scene,
    beams: Rays,
    *,
    keys: Key[Array, "f"],
    batch_size: int | None = None,
) -> Readings:
    """Read both sensors in F scenes.

    Args:
        config: sizes (static).
        scenes: `Scene` with a leading axis of F frames.
        beams: from `rays`.
        keys: `[F]` typed PRNG keys; a frame depends on its own key only.
        batch_size: frames rendered side by side; None: one after the other, best on a CPU.

    Returns:
        `Readings` with a leading axis of F.
    """

    def one(frame: tuple[Scene, PRNGKeyArray]) -> Readings:
        scene, key = frame
        by_camera, by_lidar = jax.random.split(key)
        image, depth, owner, visible, alone = _camera(config, scene, beams, by_camera)
        points, mask, point_owner = _lidar(config, scene, beams, by_lidar)
        return Readings(image, depth, owner, points, mask, point_owner, visible, alone)

    return jax.lax.map(one, (scenes, keys), batch_size=batch_size)
