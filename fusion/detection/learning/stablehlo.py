"""A trained detector as a StableHLO program, for processes that have jax but not this package."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from jaxtyping import Array, Bool, Float, UInt8

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.dense_objective import dense_detect
from fusion.detection.learning.examples import Example, camera_frame, make_inputs
from fusion.detection.learning.inference import detect
from fusion.detection.learning.training import DetectorState
from fusion.detection.network.proposals import Detections
from fusion.detection.sensors.platt import Calibration


def resize_image(image: UInt8[Array, "h w 3"], size: tuple[int, int]) -> Float[Array, "r c 3"]:
    """An image in the network's size and in [0, 1], inside jit.

    The triangle filter of `make_example`, which rounds between rows and columns as well: a pixel
    may differ by one grey level.
    """
    shape = (*size, 3)
    small = jax.image.resize(image.astype(jnp.float32), shape, "linear", antialias=True)
    return jnp.round(small) / 255.0


def _seen(
    config: DetectorConfig, points: Array, to_camera: Array, p2: Array, size: tuple[int, int]
) -> Bool[Array, "n"]:
    """Points in the picture and, with a metre more, in the area, as `make_example` keeps them."""
    there = jnp.isfinite(points).all(axis=1)
    camera = camera_frame(points, to_camera)
    u, v, depth = (camera @ p2[:, :3].T + p2[:, 3][None]).T
    u, v = u / depth, v / depth
    seen = (depth > 0) & (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
    x, z = config.bev.x_range, config.bev.z_range
    near = (camera[:, 0] > x[0] - 1) & (camera[:, 0] < x[1] + 1)
    return there & seen & near & (camera[:, 2] > z[0] - 1) & (camera[:, 2] < z[1] + 1)


def detect_raw(
    config: DetectorConfig,
    state: DetectorState,
    image: UInt8[Array, "h w 3"],
    points: Float[Array, "n 4"],
    to_camera: Float[Array, "3 4"],
    p2: Float[Array, "3 4"],
    plane: Float[Array, "4"],
    calibration: Calibration | None = None,
) -> Detections:
    """Detections of one frame as it was read, inside jit: resizing, maps, network, suppression.

    Args:
        config: static.
        state: trained.
        image: of the camera's own size.
        points: scan in the lidar frame [m], reflectance last; rows with NaN are none.
        to_camera: lidar to rectified camera, R0_rect Tr_velo_to_cam.
        p2: projection into the image.
        plane: ground plane a, b, c, d.
        calibration: of the told failures.
    """
    size = (image.shape[0], image.shape[1])
    mask = _seen(config, points, to_camera, p2, size)
    points = jnp.where(mask[:, None], points, 0.0)
    none = np.zeros((config.max_objects, 7), np.float32)
    example = Example(
        image=image,
        points=points,
        point_mask=mask,
        to_camera=to_camera,
        p2=p2,
        image_size=jnp.asarray(size, jnp.float32),
        plane=plane,
        truth=none,
        truth_mask=none[:, 0] > 0,
        ignored=none[:, 0] > 0,
        regions=none[:1, :4],
    )
    inputs = make_inputs(config, example, image=resize_image(image, config.image_size))
    run = dense_detect if config.is_dense else detect
    batch = jax.tree.map(lambda a: a[None], inputs)
    found = run(config, state.params["main"], state.stats, batch, calibration)
    return Detections(*(field[0] for field in found))


def write_detector(
    config: DetectorConfig,
    state: DetectorState,
    path: str | Path,
    *,
    image_size: tuple[int, int],
    n_points: int = 131_072,
    platforms: Sequence[str] = ("cpu",),
    calibration: Calibration | None = None,
) -> None:
    """Write a detector with its parameters as one file that `jax.export.deserialize` reads.

    The program takes one raw frame, (image, points, to_camera, p2, plane) as `detect_raw` does, and
    gives (boxes, scores, mask, weights, failed), the fields of `Detections`.

    Args:
        config: static.
        state: trained.
        path: of the file.
        image_size: rows and columns of the images that it will get.
        n_points: rows of its scans, the spare ones NaN.
        platforms: where the program is to run, such as `("cpu", "cuda")`.
        calibration: of the told failures (`calibrate_told_failures`); they are as the head tells
            them when left out.

    Raises:
        ModuleNotFoundError: flatbuffers is missing, which jax writes programs with.
        ValueError: sizes below 1, or the oracle, which would have to be told what fails.

    Example:
        >>> write_detector(config, state, "car.stablehlo",
        ...                image_size=(375, 1242))  # doctest: +SKIP
        >>> program = jax.export.deserialize(Path("car.stablehlo").read_bytes())  # doctest: +SKIP
        >>> boxes, scores, mask, weights, failed = program.call(*frame)  # doctest: +SKIP
    """
    if config.is_oracle:
        raise ValueError(
            "model='dense_oracle': expected a detector that is not told which sensor fails"
        )
    if min(*image_size, n_points) < 1:
        raise ValueError(f"image_size={image_size}, n_points={n_points}: expected at least 1 each")
    if importlib.util.find_spec("flatbuffers") is None:
        raise ModuleNotFoundError(
            "flatbuffers: expected for programs of jax.export; "
            "pip install 'snn-fusion-failure[export]'"
        )

    def program(*frame: Array) -> tuple[Array, ...]:
        image, points, *geometry = frame
        to_camera, p2, plane = geometry
        found = detect_raw(config, state, image, points, to_camera, p2, plane, calibration)
        return tuple(found)

    shapes = [
        jax.ShapeDtypeStruct((*image_size, 3), jnp.uint8),
        *(jax.ShapeDtypeStruct(s, jnp.float32) for s in ((n_points, 4), (3, 4), (3, 4), (4,))),
    ]
    made = jax_export.export(jax.jit(program), platforms=tuple(platforms))(*shapes)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(made.serialize())
