"""`train_argate --data FOLDER`: sensors of unequal shapes from CSV files and a schema."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.argate_runs import Config
from snn_fusion_failure.runs import (
    append_metrics,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
    write_text,
)

READ = (
    *("data", "model", "preset", "protocol", "n_clean", "kind", "validation", "epochs"),
    *("learning_rate", "alpha", "beta", "tau", "seed", "out", "overwrite"),
)
"""Options of `train_argate` that mean something for a folder."""


def check_options(config: Config) -> None:
    """Refuse options that a folder's network does not read.

    Raises:
        ValueError: such an option, or another protocol than clean and random.
    """
    default = Config()
    for field in dataclasses.fields(Config):
        value = getattr(config, field.name)
        if field.name not in READ and value != getattr(default, field.name):
            raise ValueError(
                f"{field.name}={value!r}: not read with --data FOLDER; leave it out, or give "
                "--data an .npz file of windows of one shape"
            )
    if config.protocol not in (None, "clean", "random"):
        raise ValueError(
            f"protocol={config.protocol!r}: expected clean or random with --data FOLDER; choose one"
        )


def train_folder(config: Config) -> dict[str, Any]:
    """Train and score on a folder; returns what `result.json` holds.

    Without a protocol one network is trained with failures drawn anew in each step, which is what
    its rows without failures (`_clean`) and with them (`_corrupted`) are scored by.
    """
    import jax

    from fusion import failures, sensor_network
    from fusion.data.csv_folder import load_folder
    from fusion.fitted_sensors import finish_sensors
    from fusion.losses import LossParams
    from fusion.target_scores import SCORES, target_scores

    check_options(config)
    data = load_folder(config.data or "", seed=config.seed, validation=config.validation)
    k = len(data.sensors)
    epochs = config.epochs or (10 if config.preset == "quick" else 30)
    given: dict[str, Any] = (
        {"learning_rate": config.learning_rate} if config.learning_rate is not None else {}
    )
    settings = sensor_network.FolderConfig(config.model, epochs=epochs, **given)
    if config.protocol == "clean":
        protocol = failures.no_failure(data.sensors)
    else:
        n_clean = (k + 1) // 2 if config.n_clean is None else config.n_clean
        protocol = failures.random_failing(data.sensors, min(n_clean, k - 1))
    named = {name: getattr(config, name) for name in ("alpha", "beta", "tau")}
    weigh = LossParams(tau=0.5, anchor=0.3)._replace(
        **{name: value for name, value in named.items() if value is not None}
    )
    kind = tuple(config.kind.split(",")) if "," in config.kind else config.kind
    out = config.out or Path("runs") / f"own_{config.model}_s{config.seed}"
    open_run(out, dataclasses.asdict(config), overwrite=config.overwrite)
    key = jax.random.key(config.seed)
    with progress() as bar:
        task = bar.add_task(config.model, total=epochs, status="")

        def show(done: int, value: float) -> None:
            bar.update(task, completed=done, status=f"loss {value:.3f}")
            append_metrics(out, {"epoch": done, "total": value})

        fitted = sensor_network.fit(
            settings, data, protocol, kind, key=key, params=weigh, on_epoch=show
        )
    finish_sensors(settings, fitted.params, data).save(out / "model.npz")
    found = sensor_network.run(
        settings, fitted.params, data, protocol, kind, key=jax.random.fold_in(key, 0)
    )
    scores = target_scores(data.kind, found.output, found.target, found.failed)
    there = data.test.available
    summary = {
        "scores": scores,
        "weights": {
            name: {
                "working": _mean(found.weights[:, s], there[:, s] & ~found.failed[:, s]),
                "failed": _mean(found.weights[:, s], found.failed[:, s]),
            }
            for s, name in enumerate(data.sensors)
        },
        "rows": {"train": len(data.train.ids), "test": len(data.test.ids)},
        "names": data.names,
        "validation": config.validation,
    }
    write_json(out / "result.json", summary | {"provenance": provenance()})
    write_text(out / "predictions.csv", _predictions(data, found))
    for name, value in scores.items():
        print(f"{name:28} {value:8.2f}")
    print(f"result.json, predictions.csv and the network, model.npz, are in {out}.")
    headline = next(iter(SCORES[data.kind]))
    shown = {name: scores[name] for name in (headline, f"{headline}_corrupted")}
    print_result(data=json.dumps(str(config.data)), model=config.model, **shown)
    return summary


def _mean(values: Any, rows: Any) -> float | None:
    return float(values[rows].mean()) if rows.any() else None


def _predictions(data: Any, found: Any) -> str:
    """CSV text: id, prediction of each column, and the sensors that failed in the row."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = ("predicted",) if data.kind == "classes" else data.names
    writer.writerow(("id", *columns, "failed"))
    for row, output in enumerate(found.output):
        if data.kind == "classes":
            said = [data.names[int(output.argmax())]]
        elif data.kind == "labels":
            said = [str(int(value > 0.0)) for value in output]
        else:
            said = [f"{value:.6g}" for value in output]
        failed = [n for n, f in zip(data.sensors, found.failed[row], strict=True) if f]
        writer.writerow((data.test.ids[row], *said, " ".join(failed)))
    return text.getvalue()
