"""Options of `train_argate`, the cases that they ask for, and one trained and scored case."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro

from snn_fusion_failure.runs import apply_changes

if TYPE_CHECKING:
    from fusion.data import Dataset
    from fusion.loop import Corruption, FitResult, TestOutput
    from fusion.presets import Preset

ProtocolName = Literal["clean", "random", "fixed", "generalisation"]
N_CLEAN = {"har": 5, "driver": 8, "simulated": 3}
"""Clean sensors of a corrupted example where none are given: about half of them."""
RANGES = {"train_range": (1, 2), "test_range": (3, 8)}
"""Fewest and most failing sensors where none are given (generalisation)."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and score a sensor-fusion network."""

    dataset: str = "har"
    """har, driver or simulated."""
    data: Path | None = None
    """Your own windows: .npz with x, y and optional names, or a folder with schema.json."""
    model: str = "argate_l"
    """baseline, netgated, argate_ws, argate_plus, argate_l; *_printed (to the letter); or
    equal_weights, modality_dropout, embracenet, oracle; spiking_argate and others of spiking_*;
    rev_conv_argate and others of rev_conv_* (reversible encoders)."""
    encoder: str | None = None
    """conv, spiking or reversible, for any model; the model's own when left out."""
    head: str | None = None
    """dense; for driver also neighbourhood (its default) and embedding."""
    gate: Literal["deterministic", "bayesian", "bayesian_whole"] = "deterministic"
    """bayesian: fusion weights with distributions, by the gate's last layer or by all of it."""
    preset: str = "paper"
    """paper (the settings of record) or quick (few epochs)."""
    protocol: ProtocolName | None = None
    """Which sensors fail: none; drawn anew; the published set; other counts in test. Left out: two
    networks, for clean and for random."""
    n_clean: int | None = None
    """Clean sensors of a corrupted example (random, fixed); about half when left out."""
    train_range: tuple[int, int] | None = None
    """Fewest and most failing sensors in training (generalisation); 1 2 when left out."""
    test_range: tuple[int, int] | None = None
    """Fewest and most failing sensors in test (generalisation); 3 8 when left out."""
    kind: str = "uniform"
    """uniform, gaussian, zero, stuck, drift, dropout, gain, clip; or several with commas."""
    redraw: bool = True
    """New noise in every epoch; --no-redraw draws it once (literal)."""
    split: str | None = None
    """How test rows are taken, e.g. trip for driver; the data set's default when left out."""
    features: str | None = None
    """Signals of driver: complete, tagged (one names trips) or source."""
    validation: bool = False
    """Score on a held-out part of the training rows instead of the test rows."""
    epochs: int | None = None
    learning_rate: float | None = None
    alpha: float | None = None
    """Weight of the auxiliary losses (Equation 3.1)."""
    beta: float | None = None
    """Weight of the fusion-weight regularization (Equation 3.1)."""
    tau: float | None = None
    """Temperature of the fixed targets."""
    normalizer: Literal["softmax", "softmax_sigmoid"] | None = None
    """Of the fusion weights and of the fixed targets; softmax_sigmoid is the printed one."""
    mask_supervision: bool = False
    """The gate also learns from the masks of simulated failures."""
    changes: Annotated[tuple[str, ...], tyro.conf.arg(name="set")] = ()
    """Changed constants, `model.loss.uniform_floor=0 train.jitter=0.1 hyper.weight_decay=1e-4`."""
    seed: int = 0
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    download: bool = False
    """Fetch the data set when it is nowhere."""
    out: Path | None = None
    """Run folder; runs/<dataset>_<model>_<protocol>_s<seed> when left out."""
    resume: bool = False
    overwrite: bool = False
    """Replace the run in the folder."""


class Case(NamedTuple):
    """One training and its test; `title` says in words which sensors fail, `noise` exactly."""

    title: str
    noise: Corruption


def build_settings(config: Config, dataset: Dataset) -> Preset:
    """Preset with the command line's changes, for a loaded data set."""
    from fusion.presets import Preset, preset

    given = {name: getattr(config, name) for name in ("head", "encoder")}
    parts: dict[str, Any] = preset(dataset, config.model, config.preset, **given)._asdict()
    named = {
        "train.epochs": config.epochs,
        "hyper.learning_rate": config.learning_rate,
        "hyper.loss.alpha": config.alpha,
        "hyper.loss.beta": config.beta,
        "hyper.loss.tau": config.tau,
        "model.normalizer": config.normalizer,
        "model.loss.fixed_targets": config.normalizer,
        "model.gate_kind": config.gate.replace("bayesian", "variational"),
        "model.loss.mask_supervision": "true" if config.mask_supervision else None,
    }
    asked = [f"{name}={value}" for name, value in named.items() if value is not None]
    return Preset(**apply_changes(parts, [*asked, *config.changes]))


def _protocols(config: Config, dataset: Dataset, name: ProtocolName) -> tuple[Any, Any, str]:
    """Protocol in training and in test, and the case in words."""
    from fusion import failures
    from fusion.data.fixed import published_fixed

    k = dataset.n_channels
    if name == "clean":
        protocol = failures.no_failure(dataset.channels)
        return protocol, protocol, "all sensors work"
    if name == "generalisation":
        train, test = (getattr(config, n) or default for n, default in RANGES.items())
        pair = failures.generalisation(dataset.channels, train, test)
        title = "{} to {} of {k} sensors fail in training, {} to {} in test"
        return (*pair, title.format(*train, *test, k=k))
    n_clean = config.n_clean
    if n_clean is None:
        n_clean = N_CLEAN.get(dataset.name, (k + 1) // 2) if name == "random" else 5
    if name == "fixed":
        protocol = published_fixed(dataset, n_clean)
        return protocol, protocol, f"the same {k - n_clean} of {k} sensors fail"
    protocol = failures.random_failing(dataset.channels, n_clean)
    return protocol, protocol, f"{k - n_clean} of {k} sensors fail"


def build_cases(config: Config, dataset: Dataset) -> dict[str, Case]:
    """What is to be trained, by the name of the protocol.

    Raises:
        ValueError: an option that the protocol does not read.
    """
    from fusion.loop import Corruption

    names: tuple[ProtocolName, ...] = (config.protocol,) if config.protocol else ("clean", "random")
    if config.n_clean is not None and not {"random", "fixed"} & set(names):
        raise ValueError(
            f"n_clean={config.n_clean}: expected --protocol random or fixed with it; leave it out"
        )
    for option in RANGES:
        if getattr(config, option) is not None and "generalisation" not in names:
            raise ValueError(
                f"{option}={getattr(config, option)}: expected --protocol generalisation with it; "
                "leave it out"
            )
    made: dict[str, Case] = {}
    for name in names:
        train, test, title = _protocols(config, dataset, name)
        kind = tuple(config.kind.split(",")) if "," in config.kind else config.kind
        noise = Corruption(train, test, kind, redraw=config.redraw)
        made[name] = Case(title, noise)
    return made


def scores(output: TestOutput, n_classes: int) -> dict[str, Any]:
    """Accuracy by part, gate scores and confusion matrix of a test output."""
    from fusion import evaluate

    predicted = output.logits.argmax(-1)
    split = evaluate.split_accuracy(output.labels, predicted, output.failed)
    result: dict[str, Any] = {
        "accuracy": 100.0 * split.overall,
        "accuracy_clean": 100.0 * split.clean,
        "accuracy_corrupted": 100.0 * split.corrupted,
        "confusion": evaluate.confusion_matrix(output.labels, predicted, n_classes),
    }
    for among in ("pooled", "channel"):
        result[f"gate_auroc_{among}"] = evaluate.gate_auroc(
            output.weights, output.failed, among=among
        )
    clean, failed = evaluate.mean_weights(output.weights, output.failed)
    return result | {"weight_clean": clean, "weight_failed": failed}


def train_and_test(
    settings: Preset, dataset: Dataset, noise: Corruption, seed: int, **options: Any
) -> tuple[FitResult, TestOutput]:
    """Train one network and run it on the test rows; `options` are those of `fusion.fit`."""
    import jax

    from fusion.loop import fit, test_output

    key = jax.random.key(seed)
    fitted = fit(*settings, dataset, noise, key=key, **options)
    return fitted, test_output(settings.model, fitted.state, dataset, noise, key=key)
