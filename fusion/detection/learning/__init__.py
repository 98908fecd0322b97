"""Examples, losses, training, detection and scoring."""

from fusion.detection.learning.augmentation import flip, in_area, turn_and_scale
from fusion.detection.learning.box_overlap import box_overlaps, overlap_loss
from fusion.detection.learning.cache import (
    TESTING,
    Cache,
    frame_part,
    open_cache,
    prepare_cache,
    read_example,
    split_frames,
    write_example,
)
from fusion.detection.learning.checkpoints import Checkpoints
from fusion.detection.learning.clean_readings import with_clean_readings
from fusion.detection.learning.dense_objective import dense_detect, dense_loss, grid_losses
from fusion.detection.learning.dense_targets import (
    GridTargets,
    average_cells,
    decode_cells,
    grid_targets,
    ignored_cells,
)
from fusion.detection.learning.detection_loss import (
    StageLoss,
    balanced_class_loss,
    class_loss,
    regression_loss,
    smooth_l1,
)
from fusion.detection.learning.examples import (
    Example,
    camera_frame,
    frame_depth,
    make_example,
    make_inputs,
    stack_examples,
)
from fusion.detection.learning.failure_calibration import (
    CalibrationReport,
    calibrate_log_odds,
    calibrate_told_failures,
    read_log_odds,
)
from fusion.detection.learning.fitting import (
    DetectorFit,
    failed_inputs,
    fit_detector,
    frame_order,
    restore_detector,
    run_detector,
    sensor_mask,
)
from fusion.detection.learning.gate_objective import (
    PathLosses,
    class_losses,
    failure_loss,
    gate_terms,
    path_losses,
)
from fusion.detection.learning.inference import detect, to_objects
from fusion.detection.learning.interrupts import interrupt_between_steps
from fusion.detection.learning.label_sizes import anchor_sizes
from fusion.detection.learning.objective import DetectorLoss, detector_loss
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.pasting import paste_objects
from fusion.detection.learning.sampling import Assignment, Sample, assign, draw
from fusion.detection.learning.scoring import (
    Camera,
    class_precision,
    frame_objects,
    image_scale,
    precision_fields,
    weight_auroc,
)
from fusion.detection.learning.sharding import frame_mesh
from fusion.detection.learning.training import (
    FAILURES,
    SENSOR_FAILURES,
    DetectorState,
    DetectorTrainConfig,
    fail_sensor,
    init_training,
    learning_rate,
    train_step,
    training_inputs,
)

__all__ = [
    "FAILURES",
    "SENSOR_FAILURES",
    "TESTING",
    "Assignment",
    "Cache",
    "CalibrationReport",
    "Camera",
    "Checkpoints",
    "DetectorFit",
    "DetectorLoss",
    "DetectorParams",
    "DetectorState",
    "DetectorTrainConfig",
    "Example",
    "GridTargets",
    "PathLosses",
    "Sample",
    "StageLoss",
    "anchor_sizes",
    "assign",
    "average_cells",
    "balanced_class_loss",
    "box_overlaps",
    "calibrate_log_odds",
    "calibrate_told_failures",
    "camera_frame",
    "class_loss",
    "class_losses",
    "class_precision",
    "decode_cells",
    "dense_detect",
    "dense_loss",
    "detect",
    "detector_loss",
    "draw",
    "fail_sensor",
    "failed_inputs",
    "failure_loss",
    "fit_detector",
    "flip",
    "frame_depth",
    "frame_mesh",
    "frame_objects",
    "frame_order",
    "frame_part",
    "gate_terms",
    "grid_losses",
    "grid_targets",
    "ignored_cells",
    "image_scale",
    "in_area",
    "init_training",
    "interrupt_between_steps",
    "learning_rate",
    "make_example",
    "make_inputs",
    "open_cache",
    "overlap_loss",
    "paste_objects",
    "path_losses",
    "precision_fields",
    "prepare_cache",
    "read_example",
    "read_log_odds",
    "regression_loss",
    "restore_detector",
    "run_detector",
    "sensor_mask",
    "smooth_l1",
    "split_frames",
    "stack_examples",
    "to_objects",
    "train_step",
    "training_inputs",
    "turn_and_scale",
    "weight_auroc",
    "with_clean_readings",
    "write_example",
]
