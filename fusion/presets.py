"""Sizes and rates of record: one recipe per data set, shared by all compared models."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from fusion._checks import check_choice
from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.data.dataset import Dataset
from fusion.encoders import EncoderConfig, reading_levels
from fusion.losses import LossParams
from fusion.models import match_parameters


class Preset(NamedTuple):
    """A network and how it is trained."""

    model: ModelConfig
    train: TrainConfig
    hyper: HyperParams


# Chosen on validation splits (held-out subjects; held-out rows), never on a test set, in short
# explorations of one seed; `scripts/studies/study_argate.py` is the whole study, see
# docs/argate.md.
_HAR = Preset(
    ModelConfig(head_widths=(128,), dropout=0.2),
    TrainConfig(epochs=15, batch_size=64),
    HyperParams(3e-3, 1e-3, LossParams(alpha=1.0, beta=1.0, tau=0.5, anchor=0.3)),
)
_DRIVER = Preset(
    ModelConfig(encoder=EncoderConfig(features=24), head_widths=(128, 128), dropout=0.05),
    TrainConfig(epochs=8, batch_size=128),
    HyperParams(4e-3, 1e-4, LossParams(alpha=1.0, beta=1.0, tau=0.5, anchor=0.3)),
)
# Small enough for demo, tests and CI.
_SIMULATED = Preset(
    ModelConfig(
        encoder=EncoderConfig(features=16, conv_features=(8, 16)),
        gate_width=16,
        head_widths=(32,),
        dropout=0.1,
    ),
    TrainConfig(epochs=40, batch_size=32),
    HyperParams(5e-3, 1e-4, LossParams(alpha=1.0, beta=1.0, tau=0.5, anchor=0.3)),
)
_BY_DATASET = {"har": _HAR, "driver": _DRIVER, "simulated": _SIMULATED}
# Equal weights in the alpha term; classes of HAR overlap, so its labels are smoothed.
_LOSS: dict[str, dict[str, Any]] = {
    "har": {"uniform_floor": 1.0, "label_smoothing": 0.05},
    "driver": {"uniform_floor": 1.0, "label_smoothing": 0.0},
    "simulated": {"uniform_floor": 1.0, "label_smoothing": 0.0},
}
_QUICK_EPOCHS = {"har": 5, "driver": 2, "simulated": 15}

PRESETS = ("quick", "paper")


def preset(dataset: Dataset, model: str = "argate_l", name: str = "paper") -> Preset:
    """Network and training of record for a data set, its size matched to that of ARGate-L.

    Args:
        dataset: gives the sizes.
        model: a name in `fusion.config.MODELS`.
        name: `"paper"` for the record, `"quick"` for the same with few epochs.

    Returns:
        Model, training and hyper-parameters; change fields with `dataclasses.replace` and
        `_replace`.

    Raises:
        ValueError: unknown preset, model or data set.
    """
    check_choice("preset", name, PRESETS)
    check_choice("model", model, MODELS)
    if dataset.name not in _BY_DATASET:
        raise ValueError(
            f"dataset.name={dataset.name!r}: expected one of {', '.join(_BY_DATASET)}, which have "
            "presets; build ModelConfig, TrainConfig and HyperParams yourself"
        )
    base = _BY_DATASET[dataset.name]
    reference = dataclasses.replace(
        base.model,
        model="argate_l",
        n_sensors=dataset.n_channels,
        n_times=dataset.n_time,
        n_classes=dataset.n_classes,
    )
    if dataset.n_time == 1:
        encoder = dataclasses.replace(base.model.encoder, levels=reading_levels(dataset.train_x))
        reference = dataclasses.replace(reference, encoder=encoder)
    config = match_parameters(dataclasses.replace(reference, model=model), reference)
    loss = dataclasses.replace(MODELS[model].loss, **_LOSS[dataset.name])
    config = dataclasses.replace(config, loss=loss)
    train = base.train
    if name == "quick":
        train = dataclasses.replace(train, epochs=_QUICK_EPOCHS[dataset.name])
    return Preset(config, train, base.hyper)
