"""Bayesian fusion weights on HAR: calibration, doubt and failed sensors, beside other ways.

    python scripts/studies/study_bayesian_gate.py --choose
    python scripts/studies/study_bayesian_gate.py

The first command trains the Bayesian gate with other priors and weights of its divergence, scores
them on validation rows and writes `results/study_bayesian_gate_choice.json`; the constants of
`CHOSEN` come from it. The second trains ARGate-L, the Bayesian gate and an
ensemble of equal training cost for each row and seed; it writes `results/study_bayesian_gate.json`.
All of them learn from the training subjects but four, which temperatures and failure scores are
fitted on; the test subjects are looked at once. Networks are kept as they come in
`runs/study_bayesian_gate`, so the same command goes on after an interruption; a training takes
about 20 s of CPU time.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.records import gate_scores
from snn_fusion_failure.records.fusion_tables import UNSEEN_KINDS
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.records.statistics import holm, paired_test
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
    write_json,
)

TITLE = "Bayesian fusion weights, HAR, networks of 17 training subjects, test subjects"
ROWS = {"clean": None, "n_clean=8": 8, "n_clean=5": 5, "n_clean=1": 1}
"""Row -> clean sensors of a corrupted example (uniform noise, in training and in test)."""
UNSEEN = "unseen kinds"
UNSEEN_OF = "n_clean=5"
"""The network that meets unseen kinds is that of this row."""
FAILURE_KINDS = (*gate_scores.SEEN_KINDS, *UNSEEN_KINDS)
MEMBERS = 3
"""Members of the ensemble; each trains for a third of the epochs."""
CHOSEN = {"gate_prior": 0.1, "divergence": 0.1, "label_smoothing": 0.0}
"""The likeliest setting of `GRID` on validation rows."""
GRID = [{"gate_prior": p, "divergence": d} for p in (1.0, 0.1) for d in (1.0, 0.1, 0.01)]
GRID += [CHOSEN]
"""What `--choose` compares."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare ways to probabilities that can be trusted."""

    choose: bool = False
    """Compare priors and weights of the divergence on validation rows instead."""
    preset: str = "paper"
    seeds: int = 5
    """Trainings per network and row."""
    networks: tuple[str, ...] = ("argate_l", "argate_l_unsmoothed", "bayesian", "ensemble")
    """`argate_l` and `bayesian` are needed; others may be left out of the table."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path = Path("runs/study_bayesian_gate")
    """Folder of the trained networks."""
    results: Path = repository.RESULTS
    """Where the table goes."""
    train_only: bool = False
    """Train what is missing and score nothing."""


def settings_of(dataset: Any, preset: str, network: str, **constants: float) -> Any:
    """Preset of a network: a third of the epochs for a member, distributions for the Bayesian."""
    from fusion.presets import preset as preset_of

    found = preset_of(dataset, "argate_l", preset)
    if network == "ensemble":
        epochs = found.train.epochs // MEMBERS
        return found._replace(train=dataclasses.replace(found.train, epochs=epochs))
    if network == "argate_l_unsmoothed":
        terms = dataclasses.replace(found.model.recipe.loss, label_smoothing=0.0)
        return found._replace(model=dataclasses.replace(found.model, loss=terms))
    if network == "bayesian":
        constants = constants or CHOSEN
        model = dataclasses.replace(
            found.model, gate_kind="variational", gate_prior=constants["gate_prior"]
        )
        smoothing = constants.get("label_smoothing", model.recipe.loss.label_smoothing)
        terms = dataclasses.replace(model.recipe.loss, label_smoothing=smoothing)
        model = dataclasses.replace(model, loss=terms)
        loss = found.hyper.loss._replace(divergence=constants["divergence"])
        return found._replace(model=model, hyper=found.hyper._replace(loss=loss))
    return found


def noise_of(dataset: Any, row: str) -> Any:
    """Which sensors fail in training and in test."""
    from fusion import failures
    from fusion.loop import Corruption

    n_clean = ROWS[row]
    if n_clean is None:
        protocol = failures.no_failure(dataset.channels)
    else:
        protocol = failures.random_failing(dataset.channels, n_clean)
    return Corruption(protocol, protocol)


def trained(path: Path, settings: Any, dataset: Any, noise: Any, key: Any) -> Any:
    """Exported parameters of a network: those kept in `path`, else of a training that is kept."""
    from fusion._array_files import flatten, read_arrays, unflatten, write_arrays
    from fusion.loop import fit
    from fusion.models import export

    if not path.exists():
        parts = settings.model, settings.train, settings.hyper
        state = fit(*parts, dataset, noise, key=key).state
        write_arrays(path, {"epochs": settings.train.epochs}, flatten(export(state.params)))
    return unflatten(read_arrays(path)[1])


def network(config: Config, dataset: Any, row: str, name: str, seed: int) -> Any:
    """Parameters of a network of the table; those of an ensemble have an axis of members."""
    import jax
    import jax.numpy as jnp

    settings, noise = settings_of(dataset, config.preset, name), noise_of(dataset, row)
    folder = config.out / config.preset / row.replace("=", "_") / name
    key = jax.random.key(seed)
    if name != "ensemble":
        return trained(folder / f"{seed}.npz", settings, dataset, noise, key)
    members = [
        trained(
            folder / f"{seed}_{m}.npz", settings, dataset, noise, jax.random.fold_in(key, 1000 + m)
        )
        for m in range(MEMBERS)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def choose(config: Config, dataset: Any) -> list[dict[str, Any]]:
    """Scores of the grid on validation rows, n_clean=5, seed 0."""
    import jax

    from fusion.evaluate import gate_auroc
    from fusion.uncertainty import sample_predictive

    noise, rows = noise_of(dataset, "n_clean=5"), []
    draw = jax.jit(sample_predictive, static_argnums=0)
    x, failed = gate_scores.corrupted(dataset.test_x, noise.test, "uniform", key=jax.random.key(7))
    for constants in GRID:
        settings = settings_of(dataset, config.preset, "bayesian", **constants)
        name = f"prior={constants['gate_prior']:g} divergence={constants['divergence']:g}"
        name += " label_smoothing=0" if "label_smoothing" in constants else ""
        path = config.out / config.preset / "choice" / f"{name.replace(' ', '_')}.npz"
        main = trained(path, settings, dataset, noise, jax.random.key(0))
        found = draw(settings.model, main, x, key=jax.random.key(1))
        scores = gate_scores.class_scores(np.asarray(found.probabilities), dataset.test_y)
        scores["gate_auroc"] = gate_auroc(np.asarray(found.weights), np.asarray(failed))
        scores["epistemic"] = float(found.epistemic.mean())
        for metric, value in scores.items():
            unit = "%" if metric == "accuracy" else "1"
            cell = {"row": name, "model": "bayesian", "metric": metric, "unit": unit}
            rows.append(cell | summarize([value]))
        print(name, {k: round(v, 4) for k, v in scores.items()}, flush=True)
    return rows


def scored(config: Config, whole: Any, dataset: Any, row: str, seed: int) -> dict[str, Any]:
    """Model -> scores of one row and seed; temperatures from validation rows, the rest from test.

    The row of unseen kinds has the mean over the kinds.
    """
    import jax

    from fusion.predictive_scores import fit_temperature

    unseen = row == UNSEEN
    of = UNSEEN_OF if unseen else row
    noise, key = noise_of(dataset, of), jax.random.key(seed)
    configs = {n: settings_of(dataset, config.preset, n).model for n in config.networks}
    mains = {n: network(config, dataset, of, n, seed) for n in config.networks}
    main = mains["argate_l"]
    laplace = gate_scores.fit_gaussian(configs["argate_l"], main, dataset, noise, key=key)
    predictors = gate_scores.predictors(configs, mains, laplace)
    held, _ = gate_scores.corrupted(
        dataset.test_x, noise.test, noise.kind, key=jax.random.fold_in(key, 12)
    )
    temperatures = {
        name: fit_temperature(
            np.log(np.maximum(gate_scores.in_chunks(predictors[name], held)[0], 1e-12)),
            dataset.test_y,
        )
        for name in gate_scores.SCALED
        if name in predictors
    }
    kinds = UNSEEN_KINDS if unseen else (noise.kind,)
    found: dict[str, list[dict[str, float]]] = {}
    for kind in kinds:
        x, failed = gate_scores.corrupted(
            whole.test_x, noise.test, kind, key=jax.random.fold_in(key, 3)
        )
        mask, classes = np.asarray(failed), np.zeros(())
        for name, predictor in predictors.items():
            p, weights = gate_scores.in_chunks(predictor, x)
            scores = gate_scores.class_scores(p, whole.test_y)
            if mask.any():
                scores["failed_auroc"] = gate_scores.auroc_of(-weights, mask)
            found.setdefault(name, []).append(scores)
            if name in temperatures:
                hot = gate_scores.heated(p, temperatures[name])
                cooled = gate_scores.class_scores(hot, whole.test_y)
                cooled["temperature"] = temperatures[name]
                found.setdefault(f"{name}, temperature", []).append(cooled)
            if name == "bayesian (samples)":
                classes = p
        shares = np.bincount(dataset.train_y, minlength=dataset.n_classes) / len(dataset.train_y)
        constant = gate_scores.class_scores(np.tile(shares, (len(x), 1)), whole.test_y)
        if mask.any():
            constant["failed_auroc"] = gate_scores.auroc_of(np.zeros(mask.shape), mask)
            others = tuple(k for k in FAILURE_KINDS if k != kind) if unseen else (kind,)
            predictor = predictors["bayesian (samples)"]
            for name, scores in gate_scores.detectors(
                configs, mains, dataset, noise, others, kind, x, classes, mask, predictor, key=key
            ).items():
                found.setdefault(name, []).append(scores)
        found.setdefault("class frequencies", []).append(constant)
    return {
        name: {m: float(np.mean([one[m] for one in each])) for m in each[0]}
        for name, each in found.items()
    }


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows in the schema of record, with differences from ARGate-L seed by seed."""
    rows: list[dict[str, Any]] = []
    for row in (*ROWS, UNSEEN):
        paths = [
            config.out / config.preset / "scores" / row / f"{s}.json" for s in range(config.seeds)
        ]
        held = [json.loads(p.read_text(encoding="utf-8")) for p in paths if p.exists()]
        if not held:
            continue
        for name in held[0]:
            for metric in held[0][name]:
                unit = "%" if metric == "accuracy" else "1"
                values = [one[name][metric] for one in held]
                cell = {"row": row, "model": name, "metric": metric, "unit": unit}
                rows.append(cell | summarize(values))
            if name in ("argate_l", "class frequencies") or "accuracy" not in held[0][name]:
                continue
            for metric in ("accuracy", "ece", "nll"):
                mine, base = ([one[n][metric] for one in held] for n in (name, "argate_l"))
                apart = {"row": row, "model": name, "metric": f"{metric}_above_argate_l"}
                apart |= {"unit": "%" if metric == "accuracy" else "1"}
                if len(held) > 1:
                    apart["p_value"] = paired_test(mine, base).p_value
                rows.append(apart | summarize([a - b for a, b in zip(mine, base, strict=True)]))
    tests = [r for r in rows if "p_value" in r]
    for r, p in zip(tests, holm([r["p_value"] for r in tests]), strict=True):
        r["p_holm"] = p
    return rows


def main(config: Config) -> dict[str, Any]:
    """Train what is missing, score, write the table."""
    enable_compilation_cache()
    from fusion.data import load, validation_split

    whole = load("har", config.data_dir)
    dataset = validation_split(whole)
    if config.choose:
        rows = choose(config, dataset)
        name = "study_bayesian_gate_choice"
        title = "Prior and weight of the divergence of the Bayesian gate, HAR, validation subjects"
        record_table(config.results / f"{name}.json", name, title, rows, preset=config.preset)
        print_result(cells=len(rows))
        return {"rows": rows}
    todo = [
        (seed, name, row)
        for seed in range(config.seeds)
        for name in config.networks
        for row in ROWS
    ]
    with progress() as bar:
        task = bar.add_task("networks", total=len(todo), status="")
        for seed, name, row in todo:
            bar.update(task, status=f"{row} {name} s{seed}")
            network(config, dataset, row, name, seed)
            bar.advance(task)
    if config.train_only:
        print_result(networks=len(todo))
        return {"rows": []}
    for seed in range(config.seeds):
        for row in (UNSEEN, *ROWS):
            path = config.out / config.preset / "scores" / row / f"{seed}.json"
            held = path.read_text("utf-8") if path.exists() else ""
            if any(f'"{name}' not in held for name in config.networks):
                write_json(path, scored(config, whole, dataset, row, seed))
                print(f"scored {row} s{seed}", flush=True)
    rows, name = collect(config), "study_bayesian_gate"
    record_table(config.results / f"{name}.json", name, TITLE, rows, preset=config.preset)
    print_result(cells=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
