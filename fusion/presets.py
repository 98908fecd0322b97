"""Sizes and rates of record: one recipe per data set, shared by all compared models."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, get_args

from fusion._checks import check_choice
from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.data.dataset import Dataset
from fusion.encoders import EncoderConfig, SeriesKind, reading_levels, readings_recur
from fusion.losses import LossParams
from fusion.reversible.config import ReversibleConfig
from fusion.sizes import match_parameters
from fusion.spiking.config import SpikingConfig
from fusion.tables import BINS, reading_ranks


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
# The same rows with a head that compares with training rows, the driver's setting of record.
_NEIGHBOURS = Preset(
    ModelConfig(
        n_times=1,
        encoder=EncoderConfig(features=11, scalar="table"),
        gate_width=64,
        own_scores=True,
        head_widths=(128, 128),
        aux_width=16,
        dropout=0.0,
        head="neighbourhood",
        memory_rows=2048,
        sharpening=3.0,
    ),
    TrainConfig(epochs=3, batch_size=256),
    HyperParams(1e-2, 0.0, LossParams(alpha=0.1, beta=0.3, tau=0.5, anchor=0.3)),
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
# The same without training rows at inference, for those who cannot ship them.
_EMBEDDING = _NEIGHBOURS._replace(
    model=dataclasses.replace(_NEIGHBOURS.model, head="dense", head_widths=(256, 128))
)
_BY_DATASET = {
    ("har", "dense"): _HAR,
    ("driver", "neighbourhood"): _NEIGHBOURS,
    ("driver", "embedding"): _EMBEDDING,
    ("driver", "dense"): _DRIVER,
    ("simulated", "dense"): _SIMULATED,
    # One's own windows of unknown size: the small network, more room in its encoders.
    ("own", "dense"): _SIMULATED._replace(
        model=dataclasses.replace(_SIMULATED.model, encoder=EncoderConfig(features=32))
    ),
}
"""(data set, head); the first of a data set is its default."""
# Equal weights in the alpha term; classes of HAR overlap, so its labels are smoothed.
_LOSS: dict[str, dict[str, Any]] = {
    "har": {"uniform_floor": 1.0, "label_smoothing": 0.05},
    "driver": {"uniform_floor": 1.0, "label_smoothing": 0.0},
    "simulated": {"uniform_floor": 1.0, "label_smoothing": 0.0},
    "own": {"uniform_floor": 1.0, "label_smoothing": 0.0},
}
_QUICK_EPOCHS = {"har": 5, "driver": 1, "simulated": 15, "own": 15}

PRESETS = ("quick", "paper")

ENCODED: dict[str, tuple[str, str]] = {
    "spiking_baseline": ("baseline", "spiking"),
    "spiking_netgated": ("netgated", "spiking"),
    "spiking_argate_plus": ("argate_plus", "spiking"),
    "spiking_argate": ("argate_l", "spiking"),
    "rev_conv_baseline": ("baseline", "reversible"),
    "rev_conv_netgated": ("netgated", "reversible"),
    "rev_conv_argate_plus": ("argate_plus", "reversible"),
    "rev_conv_argate": ("argate_l", "reversible"),
}
"""Names of a recipe with an encoder; any other pair is had by `encoder`."""

# Neurons, sizes of the network and training that go with them; chosen on validation rows, see
# docs/spiking_fusion.md. Gains that vary in training stand for the gaits of other people.
_SPIKING: dict[str, tuple[SpikingConfig, dict[str, Any], dict[str, Any]]] = {
    "har": (
        SpikingConfig(
            code="contrast", widths=(16, 32), taps=(8, 12), strides=(4, 2), threshold=0.7
        ),
        {"head_widths": (64,), "gate_width": 32},
        {"epochs": 15, "jitter": 0.3},
    ),
    "driver": (SpikingConfig(widths=(24, 24), taps=(1, 1), strides=(1, 1)), {}, {}),
    "simulated": (
        SpikingConfig(widths=(16, 24), taps=(8, 6), strides=(2, 2), threshold=0.5),
        {},
        {},
    ),
    "own": (SpikingConfig(widths=(16, 32), taps=(4, 4), strides=(1, 1)), {}, {}),
}
# Stages of the reversible encoders; see docs/reversible_fusion.md. Windows enter as they enter the
# convolutions: without their mean, times five. A scalar has nothing to squeeze, nor a mean.
_WINDOW: dict[str, Any] = {"centred": True, "gain": 5.0}
_REVERSIBLE: dict[str, tuple[ReversibleConfig, dict[str, Any], dict[str, Any]]] = {
    "har": (ReversibleConfig(**_WINDOW), {}, {}),
    "driver": (ReversibleConfig((1,), channels=24, depths=(2,), hidden=(24,), taps=(1,)), {}, {}),
    "simulated": (ReversibleConfig(hidden=(8, 16), taps=(3, 3), **_WINDOW), {}, {}),
    "own": (
        ReversibleConfig((1,), channels=8, depths=(4,), hidden=(16,), taps=(5,), **_WINDOW),
        {},
        {},
    ),
}
_BY_ENCODER: dict[str, dict[str, tuple[Any, dict[str, Any], dict[str, Any]]]] = {
    "spiking": dict(_SPIKING),
    "reversible": dict(_REVERSIBLE),
}
"""Encoder -> data set -> its config, changed sizes of the network, changed training."""
_RATE = {("har", "spiking"): 5e-3}
"""Learning rates where they are not those of the data set's preset."""


def recipe_and_encoder(model: str, encoder: str | None = None) -> tuple[str, str]:
    """The recipe that a name means, and the encoder that goes with it.

    Raises:
        ValueError: an unknown name, or an encoder that is not the name's.

    Example:
        >>> recipe_and_encoder("spiking_argate"), recipe_and_encoder("oracle", "spiking")
        (('argate_l', 'spiking'), ('oracle', 'spiking'))
    """
    check_choice("model", model, (*MODELS, *ENCODED))
    if encoder is not None:
        check_choice("encoder", encoder, get_args(SeriesKind))
    recipe, own = ENCODED.get(model, (model, encoder or "conv"))
    if encoder not in (None, own):
        raise ValueError(
            f"encoder={encoder!r}: expected {own!r}, which {model!r} has; use model={recipe!r} or "
            "leave the encoder out"
        )
    return recipe, own


def _with_encoder(base: Preset, dataset: Dataset, encoder: str) -> Preset:
    """The preset with another encoder, and with the sizes that go with it."""
    if encoder == "conv":
        return base
    own, sizes, training = _BY_ENCODER[encoder][dataset.name]
    changed: dict[str, Any] = {"series": encoder, encoder: own}
    series = dataclasses.replace(base.model.encoder, **changed)
    rate = _RATE.get((dataset.name, encoder), base.hyper.learning_rate)
    return Preset(
        dataclasses.replace(base.model, encoder=series, **sizes),
        dataclasses.replace(base.train, **training),
        base.hyper._replace(learning_rate=rate),
    )


def preset(
    dataset: Dataset,
    model: str = "argate_l",
    name: str = "paper",
    *,
    head: str | None = None,
    encoder: str | None = None,
) -> Preset:
    """Network and training of record for a data set, its size matched to that of ARGate-L.

    Args:
        dataset: gives the sizes.
        model: a name in `fusion.config.MODELS`, or one of `ENCODED`, such as `spiking_argate`.
        name: `"paper"` for the record, `"quick"` for the same with few epochs.
        head: `"dense"`; for the driver data also `"neighbourhood"` (its default), which compares
            with training rows, and `"embedding"`, the same encoders without them.
        encoder: `"conv"`, `"spiking"` or `"reversible"`; that of the model's name when None.

    Returns:
        Model, training and hyper-parameters; change fields with `dataclasses.replace` and
        `_replace`.

    Raises:
        ValueError: unknown preset, model or data set.
    """
    check_choice("preset", name, PRESETS)
    model, encoder = recipe_and_encoder(model, encoder)
    heads = [of for data, of in _BY_DATASET if data == dataset.name]
    if encoder != "conv":
        # The other heads read tables of their own encoders.
        heads = [of for of in heads if of == "dense"]
    if not heads:
        names = ", ".join(dict.fromkeys(data for data, _ in _BY_DATASET))
        raise ValueError(
            f"dataset.name={dataset.name!r}: expected one of {names}, which have "
            "presets; build ModelConfig, TrainConfig and HyperParams yourself"
        )
    head = heads[0] if head is None else head
    check_choice("head", head, heads)
    base = _with_encoder(_BY_DATASET[dataset.name, head], dataset, encoder)
    reference = dataclasses.replace(
        base.model,
        model="argate_l",
        n_sensors=dataset.n_channels,
        n_times=dataset.n_time,
        n_classes=dataset.n_classes,
    )
    if dataset.n_time == 1:
        encoders = base.model.encoder
        if encoders.scalar == "table":
            levels = reading_levels(dataset.train_x, limit=4 * BINS)
            ranks = reading_ranks(dataset.train_x, levels)
            encoders = dataclasses.replace(encoders, levels=levels, ranks=ranks)
        elif dataset.name != "own" or readings_recur(dataset.train_x):
            encoders = dataclasses.replace(encoders, levels=reading_levels(dataset.train_x))
        reference = dataclasses.replace(reference, encoder=encoders)
    config = match_parameters(dataclasses.replace(reference, model=model), reference)
    train, hyper = base.train, base.hyper
    if MODELS[model].printed:
        config = dataclasses.replace(config, normalizer="softmax_sigmoid")
        hyper = hyper._replace(loss=hyper.loss._replace(anchor=0.0))
    else:
        loss = dataclasses.replace(MODELS[model].loss, **_LOSS[dataset.name])
        config = dataclasses.replace(config, loss=loss)
    if name == "quick":
        epochs = min(train.epochs, _QUICK_EPOCHS[dataset.name])
        train = dataclasses.replace(train, epochs=epochs)
    return Preset(config, train, hyper)
