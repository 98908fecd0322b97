"""Boxes, anchors, bird's-eye maps, overlaps and ground planes."""

from fusion.detection.geometry.anchors import (
    AnchorConfig,
    Anchors,
    anchor_grid,
    cluster_sizes,
    select_anchors,
)
from fusion.detection.geometry.bev import (
    BevConfig,
    bev_maps,
    cell_index,
    ground_to_unit,
    pad_points,
)
from fusion.detection.geometry.encodings import (
    anchor_ground,
    angle_vector,
    box3d_to_anchor,
    box3d_to_box4c,
    box4c_to_box3d,
    box_corners,
    decode_offsets,
    encode_offsets,
    ground_box,
    project_boxes,
    resolve_heading,
)
from fusion.detection.geometry.inside import in_footprints, points_in_boxes
from fusion.detection.geometry.overlaps import (
    box3d_iou,
    ground_iou,
    image_iou,
    rotated_intersection,
)
from fusion.detection.geometry.planes import (
    PlaneConfig,
    PlaneFit,
    fit_plane,
    height_above,
    plane_difference,
    plane_y,
)
from fusion.detection.geometry.suppression import nms, pairwise

__all__ = [
    "AnchorConfig",
    "Anchors",
    "BevConfig",
    "PlaneConfig",
    "PlaneFit",
    "anchor_grid",
    "anchor_ground",
    "angle_vector",
    "bev_maps",
    "box3d_iou",
    "box3d_to_anchor",
    "box3d_to_box4c",
    "box4c_to_box3d",
    "box_corners",
    "cell_index",
    "cluster_sizes",
    "decode_offsets",
    "encode_offsets",
    "fit_plane",
    "ground_box",
    "ground_iou",
    "ground_to_unit",
    "height_above",
    "image_iou",
    "in_footprints",
    "nms",
    "pad_points",
    "pairwise",
    "plane_difference",
    "plane_y",
    "points_in_boxes",
    "project_boxes",
    "resolve_heading",
    "rotated_intersection",
    "select_anchors",
]
