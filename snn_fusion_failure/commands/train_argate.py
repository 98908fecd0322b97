"""Train one sensor-fusion network and score it on clean and corrupted test examples.

    python scripts/train_argate.py --dataset har --model argate_l --preset quick

trains ARGate-L on smartphone activity windows of which two thirds have eight of nine channels
replaced by noise, and ends with accuracy, a confusion matrix, the gate picture and a line
`result: ...`. `--preset quick` takes about a minute on two cores, `--preset paper` a few. With
`--dataset simulated` no data file is needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.runs import (
    append_metrics,
    enable_compilation_cache,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
)
from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and score a sensor-fusion network."""

    dataset: str = "har"
    """har, driver or simulated."""
    model: str = "argate_l"
    """baseline, netgated, argate_ws, argate_plus, argate_l; or modality_dropout, embracenet,
    oracle."""
    preset: str = "quick"
    """quick or paper (the settings of record)."""
    protocol: Literal["clean", "random", "fixed", "generalisation"] = "random"
    """Which sensors fail: none; drawn per example; the published fixed set; other counts in test
    than in training."""
    n_clean: int | None = None
    """Clean channels of a corrupted example (random, fixed); 1 for HAR, 5 for driver when left
    out."""
    train_range: tuple[int, int] = (1, 2)
    """Fewest and most failing channels in training (generalisation)."""
    test_range: tuple[int, int] = (3, 8)
    """Fewest and most failing channels in test (generalisation)."""
    kind: str = "uniform"
    """Failure kind: uniform, gaussian, zero, stuck, drift, dropout, gain, clip."""
    redraw: bool = True
    """Draw the training noise anew in every epoch; --no-redraw draws it once (literal)."""
    split: str | None = None
    """How test rows are taken, e.g. trip for driver; the data set's default when left out."""
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
    """Of the fusion weights; softmax_sigmoid is the printed one."""
    seed: int = 0
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    download: bool = False
    """Fetch the data set from its publisher when it is nowhere."""
    out: Path | None = None
    """Run folder; runs/<dataset>_<model>_<protocol>_s<seed> when left out."""
    resume: bool = False
    """Go on with the run in the folder."""
    overwrite: bool = False
    """Replace the run in the folder."""


# Options that do not change the numbers, so a resumed run may change them.
_NOT_SETTINGS = ("out", "resume", "overwrite", "data_dir", "download")


def build(config: Config, dataset: Any) -> tuple[Any, Any]:
    """Preset with the command line's changes, and the corruption, for a loaded data set."""
    from fusion import failures
    from fusion.data import published_fixed
    from fusion.loop import Corruption
    from fusion.presets import preset

    settings = preset(dataset, config.model, config.preset)
    model, train, hyper = settings
    if config.normalizer is not None:
        model = dataclasses.replace(model, normalizer=config.normalizer)
    if config.epochs is not None:
        train = dataclasses.replace(train, epochs=config.epochs)
    loss = hyper.loss._replace(
        **{n: v for n in ("alpha", "beta", "tau") if (v := getattr(config, n)) is not None}
    )
    hyper = hyper._replace(loss=loss)
    if config.learning_rate is not None:
        hyper = hyper._replace(learning_rate=config.learning_rate)

    n_clean = config.n_clean
    if n_clean is None:
        n_clean = 5 if dataset.name == "driver" or config.protocol == "fixed" else 1
    if config.protocol == "clean":
        train_protocol = test_protocol = failures.no_failure(dataset.channels)
    elif config.protocol == "random":
        train_protocol = test_protocol = failures.random_failing(dataset.channels, n_clean)
    elif config.protocol == "fixed":
        train_protocol = test_protocol = published_fixed(dataset, n_clean)
    else:
        train_protocol, test_protocol = failures.generalisation(
            dataset.channels, config.train_range, config.test_range
        )
    if config.kind not in failures.FAILURE_KINDS:
        raise ValueError(
            f"failure kind {config.kind!r} is unknown, expected one of "
            f"{', '.join(failures.FAILURE_KINDS)}"
        )
    corruption = Corruption(train_protocol, test_protocol, config.kind, redraw=config.redraw)
    return settings._replace(model=model, train=train, hyper=hyper), corruption


def scores(output: Any, n_classes: int) -> dict[str, Any]:
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


def main(config: Config) -> dict[str, Any]:
    """Train, score, draw; returns what `result.json` holds."""
    enable_compilation_cache()
    import jax
    import numpy as np

    from fusion import plots
    from fusion.data import load, validation_split
    from fusion.loop import fit, test_output
    from fusion.models import count_parameters

    dataset = load(config.dataset, config.data_dir, download=config.download, split=config.split)
    if config.validation:
        dataset = validation_split(dataset, seed=config.seed)
    settings, corruption = build(config, dataset)
    name = f"{config.dataset}_{config.model}_{config.protocol}_s{config.seed}"
    out = config.out or Path("runs") / name
    chosen = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_SETTINGS}
    open_run(out, chosen, resume=config.resume, overwrite=config.overwrite)
    checkpoints = out / "checkpoints"
    if config.overwrite and checkpoints.exists():
        import shutil

        shutil.rmtree(checkpoints)

    key = jax.random.key(config.seed)
    with progress() as bar:
        task = bar.add_task(
            f"{config.dataset} {config.model}", total=settings.train.epochs, status=""
        )

        def show(epoch: int, row: dict[str, float]) -> None:
            status = f"loss {row['total']:.3f} accuracy {100 * row['accuracy']:.1f} %"
            bar.update(task, completed=epoch, status=status)
            append_metrics(out, {"epoch": epoch, **row})

        result = fit(
            key,
            dataset,
            settings.model,
            settings.train,
            settings.hyper,
            corruption,
            checkpoint_dir=checkpoints,
            resume=config.resume,
            on_epoch=show,
        )
    output = test_output(key, result.state, dataset, settings.model, corruption)
    summary = scores(output, dataset.n_classes) | {
        "parameters": count_parameters(settings.model),
        "epochs": settings.train.epochs,
        "rows": "validation" if config.validation else "test",
    }
    write_json(out / "result.json", summary | {"provenance": provenance()})

    pictures = {
        "confusion.png": plots.plot_confusion(summary["confusion"], dataset.classes),
        "training.png": plots.plot_training(
            {
                config.model: {
                    metric: np.asarray([row[metric] for row in result.history])
                    for metric in ("total", "accuracy")
                }
            }
        ),
    }
    if output.failed.any():
        pictures["gate.png"] = plots.plot_gate(output.weights, output.failed, dataset.channels)
    for file, figure in pictures.items():
        figure.savefig(out / file, dpi=120)
    print(f"{len(output.labels)} {summary['rows']} examples; pictures and result.json in {out}")
    print_result(
        dataset=config.dataset,
        model=config.model,
        accuracy=summary["accuracy"],
        clean=summary["accuracy_clean"],
        corrupted=summary["accuracy_corrupted"],
        gate_auroc=summary["gate_auroc_pooled"],
    )
    return summary


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
