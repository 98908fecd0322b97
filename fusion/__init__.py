"""Gated multi-sensor fusion that survives sensor failure (ARGate), and monotone lattices.

- Data: `load`, `from_arrays`, `validation_split`. Failures: `Protocol` and its makers, `corrupt`.
- Networks: `ModelConfig`, `export`, `predict`. Use: `finish`, `FittedARGate`.
- Training: `preset`, `fit`, `make_train`, `test_output`, `split_accuracy`.

The modules build on each other in this order: `lattice` (usable alone), `encoders`, `gating`,
`losses`, `targets`, `models`, `failures`, `train`, `evaluate`, `data`, `loop`, `presets`,
`monitor`, `fitted`; `modules` (flax), `estimator` (scikit-learn) and `plots` stand beside them.
"""

from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data import Dataset, from_arrays, load, validation_split
from fusion.encoders import EncoderConfig
from fusion.evaluate import split_accuracy
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
from fusion.losses import LossConfig, LossParams
from fusion.models import export, predict
from fusion.presets import preset
from fusion.train import make_train

__all__ = [
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
    "corrupt",
    "export",
    "finish",
    "fit",
    "fixed_failing",
    "from_arrays",
    "generalisation",
    "load",
    "make_train",
    "no_failure",
    "predict",
    "preset",
    "random_failing",
    "split_accuracy",
    "test_output",
    "validation_split",
]
