"""Train sensor-fusion networks and score them on clean and corrupted test examples.

    python scripts/train_argate.py --dataset har

trains ARGate-L twice on smartphone activity windows, with all sensors working and with four of nine
replaced by noise in two thirds of the windows, and ends with both accuracies beside the source's,
pictures, and a line `result: ...`: a minute and a half of CPU time. `--protocol` trains one case.
`--preset quick` takes few epochs; the default `paper` has the settings of record. With
`--dataset simulated` no data file is needed; `--data my.npz` takes your own windows: arrays `x`
[N, K, T] and `y` [N], and if you like `groups` [N], `channels` [K] and `classes` [C], and keeps the
trained networks in files that `fusion.FittedARGate.load` and `watch_sensors.py --model` read; and
`--data FOLDER` takes sensors of unequal shapes from CSV files and a schema, see docs/data.md.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.argate_networks import keep, kept_sentence, network_files
from snn_fusion_failure.commands.argate_report import ceiling_of, draw, printed, sentence, table
from snn_fusion_failure.commands.argate_runs import (
    Case,
    Config,
    build_cases,
    build_settings,
    scores,
    train_and_test,
)
from snn_fusion_failure.runs import (
    append_metrics,
    enable_compilation_cache,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
    write_text,
)
from snn_fusion_failure.runs.command import run_command

# Options that do not change the numbers, so a resumed run may change them.
_NOT_SETTINGS = ("out", "resume", "overwrite", "data_dir", "download")


def forget_from(out: Path, case: str, epoch: int) -> None:
    """Drop lines of `metrics.jsonl` from this epoch on: they are about to be written again.

    A last line that a kill has torn goes as well; append to it, and two lines are lost.
    """
    path = out / "metrics.jsonl"
    if not path.exists():
        return
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    rows = [(line, json.loads(line)) for line in lines if line.endswith("\n")]
    kept = [line for line, row in rows if row["case"] != case or row["epoch"] < epoch]
    if len(kept) < len(lines):
        write_text(path, "".join(kept))


def train_case(
    config: Config, settings: Any, dataset: Any, name: str, case: Case, out: Path
) -> tuple[dict[str, Any], Any, Any]:
    """Train one case with a progress bar and score it: (scores, fitted, test output)."""
    with progress() as bar:
        task = bar.add_task(f"{config.model} {name}", total=settings.train.epochs, status="")
        written = 0

        def show(epoch: int, row: dict[str, float]) -> None:
            nonlocal written
            status = f"loss {row['total']:.3f} accuracy {100 * row['accuracy']:.1f} %"
            bar.update(task, completed=epoch, status=status)
            if not written:
                forget_from(out, name, epoch)
            written += 1
            append_metrics(out, {"case": name, "epoch": epoch, **row})

        fitted, output = train_and_test(
            settings,
            dataset,
            case.noise,
            config.seed,
            checkpoint_dir=out / "checkpoints" / name,
            resume=config.resume,
            on_epoch=show,
        )
    found = scores(output, dataset.n_classes)
    found |= {
        "title": case.title,
        "source": printed(config, case.noise),
        "ceiling": ceiling_of(dataset, case.noise),
    }
    return found, fitted, output


def main(config: Config) -> dict[str, Any]:
    """Train, score, draw; returns what `result.json` holds."""
    enable_compilation_cache()
    if config.data is not None and config.data.is_dir():
        from snn_fusion_failure.commands.argate_folder import train_folder

        return train_folder(config)
    from fusion.data import load, validation_split
    from fusion.sizes import count_parameters

    if config.data is not None:
        from fusion.data.own_file import load_file

        dataset = load_file(config.data)
        config = dataclasses.replace(config, dataset=dataset.name)
    else:
        dataset = load(
            config.dataset,
            config.data_dir,
            download=config.download,
            split=config.split,
            features=config.features,
        )
    if config.validation:
        dataset = validation_split(dataset, seed=config.seed)
    settings, cases = build_settings(config, dataset), build_cases(config, dataset)
    label = config.protocol or "cases"
    out = config.out or Path("runs") / f"{config.dataset}_{config.model}_{label}_s{config.seed}"
    chosen = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_SETTINGS}
    open_run(out, chosen, resume=config.resume, overwrite=config.overwrite)
    if config.overwrite and (out / "checkpoints").exists():
        import shutil

        shutil.rmtree(out / "checkpoints")

    found: dict[str, dict[str, Any]] = {}
    trained: dict[str, list[Any]] = {}
    files = network_files(config, cases, out)
    for name, case in cases.items():
        found[name], fitted, output = train_case(config, settings, dataset, name, case, out)
        trained[name] = [fitted.history, output]
        if name in files:
            keep(files[name], settings, dataset, case, fitted.state, config.seed)
    summary = {
        **found[list(found)[-1]],
        "cases": found,
        "parameters": count_parameters(settings.model),
        "epochs": settings.train.epochs,
        "rows": "validation" if config.validation else "test",
        "networks": {name: path.name for name, path in files.items()},
    }
    write_json(out / "result.json", summary | {"provenance": provenance()})
    draw(out, config, dataset, found, trained)
    print(table(found))
    print(sentence(config, settings, dataset, found))
    print(f"Pictures and result.json are in {out}.")
    if files:
        print(kept_sentence(files, summary["rows"]))
    fields = {}
    for name, row in found.items():
        fields["accuracy" if config.protocol else name] = row["accuracy"]
        if row["source"] is not None:
            fields["source" if config.protocol else f"{name}_source"] = row["source"]
    print_result(dataset=config.dataset, model=config.model, **fields)
    return summary


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
