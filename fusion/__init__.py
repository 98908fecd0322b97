"""Gated multi-sensor fusion that survives sensor failure (ARGate), and monotone lattices.

The modules build on each other in this order: `lattice` (usable alone), `encoders`, `gating`,
`losses`, `targets`, `models`, `failures`, `train`, `evaluate`, `data`, `fit`, `presets`, `plots`.
"""

from fusion import evaluate, failures, lattice, losses
from fusion.data import Dataset, load, validation_split
from fusion.encoders import EncoderConfig, conv1d
from fusion.failures import Protocol, corrupt
from fusion.gating import normalize, oracle_weights
from fusion.loop import Corruption, fit, test_output
from fusion.losses import LossConfig, LossParams, argate_loss
from fusion.models import MODELS, ModelConfig, export, init, match_parameters, predict
from fusion.presets import preset
from fusion.train import HyperParams, TrainConfig, init_state, make_epoch, make_train

__all__ = [
    "MODELS",
    "Corruption",
    "Dataset",
    "EncoderConfig",
    "HyperParams",
    "LossConfig",
    "LossParams",
    "ModelConfig",
    "Protocol",
    "TrainConfig",
    "argate_loss",
    "conv1d",
    "corrupt",
    "evaluate",
    "export",
    "failures",
    "fit",
    "init",
    "init_state",
    "lattice",
    "load",
    "losses",
    "make_epoch",
    "make_train",
    "match_parameters",
    "normalize",
    "oracle_weights",
    "predict",
    "preset",
    "test_output",
    "validation_split",
]
