"""Gated multi-sensor fusion that survives sensor failure (ARGate), and monotone lattices.

Data: `load`, `Dataset`. Failures: `Protocol` and its makers, `corrupt`. Networks: `ModelConfig`,
`init`, `predict`. Training: `preset`, `fit`, `make_train`, `test_output`. Use: `finish`,
`FittedARGate`. The modules build on each other in this order: `lattice` (usable alone), `encoders`,
`gating`, `losses`, `targets`, `models`, `failures`, `train`, `evaluate`, `data`, `loop`, `presets`,
`monitor`, `fitted`; `modules` (flax), `estimator` (scikit-learn) and `plots` stand beside them.
"""

from fusion import evaluate, failures, lattice, losses  # noqa: F401
from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.data import Dataset, load, validation_split
from fusion.encoders import EncoderConfig
from fusion.failures import (
    Protocol,
    corrupt,
    fixed_failing,
    generalisation,
    no_failure,
    random_failing,
)
from fusion.fitted import FittedARGate, finish
from fusion.loop import Corruption, TrainingDiverged, fit, test_output
from fusion.losses import LossConfig, LossParams, argate_loss, gate_penalty
from fusion.models import export, init, predict
from fusion.presets import preset
from fusion.train import make_train

__all__ = [
    "MODELS",
    "Corruption",
    "Dataset",
    "EncoderConfig",
    "FittedARGate",
    "HyperParams",
    "LossConfig",
    "LossParams",
    "ModelConfig",
    "Protocol",
    "TrainConfig",
    "TrainingDiverged",
    "argate_loss",
    "corrupt",
    "export",
    "finish",
    "fit",
    "fixed_failing",
    "gate_penalty",
    "generalisation",
    "init",
    "load",
    "make_train",
    "no_failure",
    "predict",
    "preset",
    "random_failing",
    "test_output",
    "validation_split",
]
