"""Frames as arrays of fixed size, and what the networks read: failures, flips, maps, anchors.

`make_example` runs once a frame on the host; `make_inputs` runs inside jit, so that a sensor can
fail differently each time that the frame is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.anchors import Anchors, anchor_grid, select_anchors
from fusion.detection.geometry.bev import bev_maps
from fusion.detection.geometry.planes import PlaneConfig, fit_plane, height_above
from fusion.detection.kitti.average_precision import NEIGHBOUR
from fusion.detection.kitti.calibration import in_image, lidar_to_camera, project
from fusion.detection.kitti.files import Frame
from fusion.detection.kitti.objects import DONT_CARE
from fusion.detection.learning.augmentation import flip, in_area, turn_and_scale
from fusion.detection.network.inputs import Inputs
from fusion.detection.sensors.depth import depth_image

MAX_REGIONS = 8  # DontCare regions of a frame
MEAN_RGB = (92.84 / 255, 97.80 / 255, 93.58 / 255)  # of the training images (AVOD)


class Example(NamedTuple):
    """One frame, or with a leading axis a batch, as it is cached.

    Attributes:
        image: `[h, w, 3]` uint8, resized.
        points: `[p, 4]` lidar frame, reflectance last; padded; only points seen in the image.
        point_mask: `[p]`.
        to_camera: `[3, 4]` lidar to rectified camera.
        p2: `[3, 4]` projection into the image of the original size.
        image_size: `[2]` original rows and columns.
        plane: `[4]` ground plane.
        truth, truth_mask: `[g, 7]` labelled boxes in the area, padded, and which rows are of the
            target class.
        ignored: `[g]` rows of the neighbouring class (vans for cars), neither cars nor background.
        regions: `[MAX_REGIONS, 4]` left, top, right, bottom of DontCare regions in pixels of the
            original image; zeros for none.
    """

    image: np.ndarray | Array
    points: np.ndarray | Array
    point_mask: np.ndarray | Array
    to_camera: np.ndarray | Array
    p2: np.ndarray | Array
    image_size: np.ndarray | Array
    plane: np.ndarray | Array
    truth: np.ndarray | Array
    truth_mask: np.ndarray | Array
    ignored: np.ndarray | Array
    regions: np.ndarray | Array


# Share of the points near the expected ground that lie on the fitted plane. With the camera 0.9 m
# lower than it is said to be, it is 0.13 to 0.37 on real frames, and 0.42 to 0.8 otherwise.
_LEAST_ROAD, _LEAST_AWAY = 0.25, 0.4  # in any case; where the height is not the expected one
_BELOW, _MOST_BELOW = 0.7, 0.3  # [m], share of points that may lie below a given plane


def _ground(frame: Frame, camera: np.ndarray, expected: PlaneConfig) -> np.ndarray:
    """The frame's plane, or the one that is fitted; both are looked at."""
    if frame.plane is not None:
        below = (height_above(frame.plane, camera) < -_BELOW).mean()
        if below > _MOST_BELOW:
            raise ValueError(
                f"frame {frame.name}: {100 * below:.0f} % of the points lie more than {_BELOW} m "
                "below the given ground plane: wrong plane, axes or calibration?"
            )
        return frame.plane
    try:
        fit = fit_plane(camera, expected)
    except ValueError as error:
        raise ValueError(f"frame {frame.name}: {error}") from None
    away = abs(fit.plane[3] - expected.camera_height) > 0.5 * expected.height_tolerance
    least = _LEAST_AWAY if away else _LEAST_ROAD
    if fit.inlier_share < least:
        raise ValueError(
            f"frame {frame.name}: {100 * fit.inlier_share:.0f} % of the points near the expected "
            f"ground lie on one plane, expected at least {100 * least:.0f} %: is the camera "
            f"{expected.camera_height:g} m above the road and level? Give its height and tilt, or "
            "plane files"
        )
    return fit.plane


def _labelled_boxes(config: DetectorConfig, frame: Frame) -> tuple[np.ndarray, np.ndarray, int]:
    """Boxes `[g, 7]` of the target class and, after them, of its neighbour; which rows are the
    latter's; how many of the former had no room."""
    truth = np.zeros((config.max_objects, 7), np.float32)
    ignored = np.zeros(config.max_objects, bool)
    if frame.labels is None:
        return truth, ignored, 0
    labels = frame.labels
    x, z = config.bev.x_range, config.bev.z_range
    at_x, at_z = labels.location[:, 0], labels.location[:, 2]
    # No anchor stands outside the area, and no feature map reaches there.
    inside = (at_x > x[0]) & (at_x < x[1]) & (at_z > z[0]) & (at_z < z[1])
    inside &= (labels.dimensions > 0).all(axis=1)
    nearest = np.argsort(labels.location[:, 2], kind="stable")
    wanted = nearest[(inside & (labels.type == config.target))[nearest]]
    lost = max(0, len(wanted) - config.max_objects)
    wanted = wanted[: config.max_objects]
    others = nearest[(inside & (labels.type == NEIGHBOUR.get(config.target, "")))[nearest]]
    rows = np.concatenate([wanted, others])[: config.max_objects]
    n = len(rows)
    truth[:n, :3] = labels.location[rows]
    truth[:n, 3:6] = labels.dimensions[rows][:, [2, 1, 0]]
    truth[:n, 6] = labels.rotation_y[rows]
    ignored[len(wanted) : n] = True
    return truth, ignored, lost


def make_example(
    config: DetectorConfig,
    frame: Frame,
    ground: PlaneConfig | None = None,
    *,
    plane: np.ndarray | None = None,
) -> tuple[Example, dict[str, int | bool]]:
    """Arrays of a frame, and what had to be left out of them.

    Args:
        config: gives the sizes.
        frame: as read; without a plane file the ground plane is fitted.
        ground: where the plane is looked for; the benchmark's car when left out.
        plane: `[4]` ground of a corrupted copy of a frame, known from the frame itself. The scan
            is then taken as it is: no plane is fitted or looked at, and no point need be there.

    Returns:
        The example and counts: `plane_fitted`, `points_dropped` (in the image, over `max_points`),
        `labels_dropped` (cars over `max_objects`, farthest first). Vans take the rows that cars
        leave free.

    Raises:
        ValueError: no lidar point lies in the image, no ground plane is found, too few points lie
            on it, or too many below a given one; the message names the frame.
    """
    from PIL import Image

    height, width = frame.image.shape[:2]
    camera = lidar_to_camera(frame.calibration, frame.points[:, :3])
    seen = in_image(*project(frame.calibration, camera), height, width)
    if not seen.any() and plane is None:
        raise ValueError(
            f"frame {frame.name}: none of {len(seen)} lidar points lies in the image: wrong "
            "calibration, or axes other than x forward, y left, z up?"
        )
    fitted = plane is None and frame.plane is None
    plane = _ground(frame, camera, ground or PlaneConfig()) if plane is None else plane
    x, z = config.bev.x_range, config.bev.z_range
    # A metre more than the area: a failing lidar moves points.
    near = (camera[:, 0] > x[0] - 1) & (camera[:, 0] < x[1] + 1)
    near &= (camera[:, 2] > z[0] - 1) & (camera[:, 2] < z[1] + 1)
    kept = np.flatnonzero(seen & near)
    dropped = max(0, len(kept) - config.max_points)
    if dropped:
        kept = np.sort(np.random.RandomState(0).permutation(kept)[: config.max_points])
    points = np.zeros((config.max_points, 4), np.float32)
    points[: len(kept)] = frame.points[kept]

    truth, ignored, lost = _labelled_boxes(config, frame)
    regions = np.zeros((MAX_REGIONS, 4), np.float32)
    if frame.labels is not None:
        away = frame.labels.bbox[frame.labels.type == DONT_CARE][:MAX_REGIONS]
        regions[: len(away)] = away

    rows, columns = config.image_size
    resized = Image.fromarray(frame.image).resize((columns, rows), Image.Resampling.BILINEAR)
    rect, velo = np.eye(4), np.eye(4)
    rect[:3, :3], velo[:3] = frame.calibration.r0_rect, frame.calibration.velo_to_cam
    example = Example(
        image=np.asarray(resized),
        points=points,
        point_mask=np.arange(config.max_points) < len(kept),
        to_camera=(rect @ velo)[:3].astype(np.float32),
        p2=frame.calibration.p2.astype(np.float32),
        image_size=np.array([height, width], np.float32),
        plane=plane.astype(np.float32),
        truth=truth,
        truth_mask=(truth[:, 3] > 0) & ~ignored,
        ignored=ignored,
        regions=regions,
    )
    counts = {
        "plane_fitted": fitted,
        "points_dropped": dropped,
        "labels_dropped": lost,
    }
    return example, counts


def stack_examples(examples: Sequence[Example]) -> Example:
    """A batch of examples of equal sizes."""
    return Example(*(np.stack(column) for column in zip(*examples, strict=True)))


def camera_frame(points: Any, to_camera: Any) -> Float[Array, "p 3"]:
    """Points of a scan `[p, 3 or more]` in the camera frame, by `[3, 4]` rotation and shift."""
    matrix = jnp.asarray(to_camera)
    return jnp.asarray(points)[:, :3] @ matrix[:, :3].T + matrix[:, 3][None]


def frame_depth(config: DetectorConfig, example: Example) -> Float[Array, "h w"]:
    """Distance of what each pixel of the frame's resized image shows [m], inside jit."""
    camera = camera_frame(example.points, example.to_camera)
    mask, p2 = jnp.asarray(example.point_mask), jnp.asarray(example.p2)
    size, plane = jnp.asarray(example.image_size), jnp.asarray(example.plane)
    return depth_image(config.image_size, camera, mask, p2, size, plane)


def make_inputs(
    config: DetectorConfig,
    example: Example,
    *,
    image: Float[Array, "h w 3"] | None = None,
    points: tuple[Float[Array, "p 4"], Bool[Array, "p"]] | None = None,
    mirror: Bool[Array, ""] | None = None,
    turn: tuple[Float[Array, ""], Float[Array, ""]] | None = None,
    key: PRNGKeyArray | None = None,
    colour_sd: float = 0.0,
    told: Float[Array, "2"] | None = None,
) -> Inputs:
    """Maps and anchors of one frame, inside jit.

    Args:
        config: static.
        example: one frame.
        image, points: readings that replace the example's, such as those of a failed sensor; the
            image in [0, 1].
        mirror: flip the frame.
        turn: angle [rad] and factor of `turn_and_scale`; cars that leave the area are no labels.
        key, colour_sd: shift of the colour channels in training, standard deviation in [0, 1].
        told: severity of the failure of (camera, lidar), for the oracle; zeros when left out.
    """
    if image is None:
        image = jnp.asarray(example.image).astype(jnp.float32) / 255.0
    cloud, mask = points if points is not None else (example.points, example.point_mask)
    camera = camera_frame(cloud, example.to_camera)
    p2, plane, truth = (jnp.asarray(a) for a in (example.p2, example.plane, example.truth))
    size = jnp.asarray(example.image_size)
    if mirror is not None:
        plain = image, camera, p2, plane, truth
        flipped = flip(image, camera, p2, size[1], plane, truth)
        image, camera, p2, plane, truth = jax.tree.map(
            lambda a, b: jnp.where(mirror, a, b), flipped, plain
        )
    truth_mask, ignored = jnp.asarray(example.truth_mask), jnp.asarray(example.ignored)
    regions = jnp.asarray(example.regions)
    if mirror is not None:
        mirrored = size[1] - 1.0 - regions[:, jnp.array([2, 1, 0, 3])]
        mirrored = mirrored.at[:, 1::2].set(regions[:, 1::2])
        mirrored = jnp.where(regions[:, 2:3] > regions[:, :1], mirrored, 0.0)
        regions = jnp.where(mirror, mirrored, regions)
    if turn is not None:
        camera, p2, plane, truth = turn_and_scale(*turn, camera, p2, plane, truth)
        truth_mask = truth_mask & in_area(config.bev, truth)
    image = image - jnp.array(MEAN_RGB)[None, None]
    if key is not None and colour_sd > 0:
        image = image + colour_sd * jax.random.normal(key, (1, 1, 3))
    mask = jnp.asarray(mask)
    if config.is_dense:  # has no anchors, and choosing them would cost as much as the map
        none = jnp.zeros(0, jnp.int32)
        anchors = Anchors(jnp.zeros((0, 6)), none, none > 0, jnp.zeros((), jnp.int32))
    else:
        grid = anchor_grid(config.anchors, config.bev, plane)
        anchors = select_anchors(config.anchors, config.bev, grid, camera, mask, plane)
    return Inputs(
        image=image,
        bev=bev_maps(config.bev, camera, mask, plane),
        anchors=anchors.boxes,
        anchor_mask=anchors.mask,
        n_occupied=anchors.n_occupied,
        p2=p2,
        image_size=size,
        plane=plane,
        truth=truth,
        truth_mask=truth_mask,
        ignored=ignored,
        regions=regions,
        told=jnp.zeros(2, jnp.float32) if told is None else told,
    )
