"""Car detection on KITTI: files, geometry, AVOD and AVOD-ARGate, average precision.

The modules hold more than is listed here. The simulator is in `fusion.detection.simulator`,
pictures are in `fusion.detection.plots`, which is imported on its own. Functions that have the name
of their module (`evaluate.evaluate`, `detect.detect`, `nms.nms`) are left there.
"""

from fusion.detection.config import DetectorConfig, detector_preset
from fusion.detection.geometry.anchors import (
    AnchorConfig,
    anchor_grid,
    cluster_sizes,
    select_anchors,
)
from fusion.detection.geometry.bev import BevConfig, bev_maps, pad_points
from fusion.detection.geometry.overlaps import box3d_iou, ground_iou, image_iou
from fusion.detection.geometry.planes import PlaneConfig, PlaneFit, fit_plane
from fusion.detection.geometry.proposals import Detections
from fusion.detection.kitti.average_precision import Evaluation, average_precision_cap
from fusion.detection.kitti.calibration import (
    Calibration,
    camera_to_lidar,
    lidar_to_camera,
    project,
)
from fusion.detection.kitti.files import (
    Frame,
    read_calibration,
    read_frame,
    read_image,
    read_labels,
    read_plane,
    read_points,
    read_results,
    read_split,
    write_labels,
    write_results,
)
from fusion.detection.kitti.objects import Objects
from fusion.detection.learning.cache import Cache, open_cache, prepare_cache
from fusion.detection.learning.detect import to_objects
from fusion.detection.learning.examples import (
    Example,
    Inputs,
    make_example,
    make_inputs,
    stack_examples,
)
from fusion.detection.learning.fitting import (
    DetectorFit,
    fit_detector,
    restore_detector,
    run_detector,
)
from fusion.detection.learning.scoring import (
    car_precision,
    frame_objects,
    precision_fields,
    weight_auroc,
)
from fusion.detection.learning.sensor_failures import camera_failure, lidar_failure
from fusion.detection.learning.training import (
    SENSOR_FAILURES,
    DetectorState,
    DetectorTraining,
    fail_sensor,
    train_step,
    training_preset,
)
from fusion.detection.network.crop import crop_and_resize
from fusion.detection.network.detector import Detector, count_main_parameters, init_detector

__all__ = [
    "SENSOR_FAILURES",
    "AnchorConfig",
    "BevConfig",
    "Cache",
    "Calibration",
    "Detections",
    "Detector",
    "DetectorConfig",
    "DetectorFit",
    "DetectorState",
    "DetectorTraining",
    "Evaluation",
    "Example",
    "Frame",
    "Inputs",
    "Objects",
    "PlaneConfig",
    "PlaneFit",
    "anchor_grid",
    "average_precision_cap",
    "bev_maps",
    "box3d_iou",
    "camera_failure",
    "camera_to_lidar",
    "car_precision",
    "cluster_sizes",
    "count_main_parameters",
    "crop_and_resize",
    "detector_preset",
    "fail_sensor",
    "fit_detector",
    "fit_plane",
    "frame_objects",
    "ground_iou",
    "image_iou",
    "init_detector",
    "lidar_failure",
    "lidar_to_camera",
    "make_example",
    "make_inputs",
    "open_cache",
    "pad_points",
    "precision_fields",
    "prepare_cache",
    "project",
    "read_calibration",
    "read_frame",
    "read_image",
    "read_labels",
    "read_plane",
    "read_points",
    "read_results",
    "read_split",
    "restore_detector",
    "run_detector",
    "select_anchors",
    "stack_examples",
    "to_objects",
    "train_step",
    "training_preset",
    "weight_auroc",
    "write_labels",
    "write_results",
]
