"""The two-stage detector as flax modules, and the way through it."""

from fusion.detection.network.build import count_main_parameters, init_detector
from fusion.detection.network.convolution import convolve
from fusion.detection.network.crop import crop_and_resize
from fusion.detection.network.dense import (
    N_OUTPUTS,
    DenseAuxiliary,
    DenseDetector,
    Grids,
    init_dense,
)
from fusion.detection.network.detector import (
    AuxiliaryHeads,
    Detector,
    Encoded,
    crop_views,
    fuse,
    init_avod,
    teach_if_alive,
)
from fusion.detection.network.forward import (
    Scored,
    encode,
    propose_boxes,
    score_anchors,
    score_proposals,
)
from fusion.detection.network.group_norm import GROUP_SIZE, group_norm_relu
from fusion.detection.network.heads import (
    CleanReadings,
    GridGate,
    MapGate,
    QualityHead,
    RpnHead,
    SecondHead,
)
from fusion.detection.network.initialize import init_weights
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.lifting import grid_centres, lift
from fusion.detection.network.proposals import (
    Detections,
    anchor_boxes,
    decode_second,
    final_boxes,
    propose,
    view_boxes,
)
from fusion.detection.network.views import FeaturePyramid, TransposedConv

__all__ = [
    "GROUP_SIZE",
    "N_OUTPUTS",
    "AuxiliaryHeads",
    "CleanReadings",
    "DenseAuxiliary",
    "DenseDetector",
    "Detections",
    "Detector",
    "Encoded",
    "FeaturePyramid",
    "GridGate",
    "Grids",
    "Inputs",
    "MapGate",
    "QualityHead",
    "RpnHead",
    "Scored",
    "SecondHead",
    "TransposedConv",
    "anchor_boxes",
    "convolve",
    "count_main_parameters",
    "crop_and_resize",
    "crop_views",
    "decode_second",
    "encode",
    "final_boxes",
    "fuse",
    "grid_centres",
    "group_norm_relu",
    "init_avod",
    "init_dense",
    "init_detector",
    "init_weights",
    "lift",
    "propose",
    "propose_boxes",
    "score_anchors",
    "score_proposals",
    "teach_if_alive",
    "view_boxes",
]
