"""Networks that `train_argate --data my.npz` keeps, ready for raw windows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.argate_runs import Case, Config

FALSE_ALARM_RATE = 0.01
"""Share of working sensors that a kept network calls failed, or one of the rows where too few."""


def network_files(config: Config, cases: Iterable[str], out: Path) -> dict[str, Path]:
    """Case -> where its network goes: `model.npz`, or `model_CASE.npz` of several.

    None are kept of the published data sets, which anyone can train again, nor of the oracle gate,
    which would have to be told what fails.
    """
    names = list(cases)
    if config.data is None or config.model == "oracle":
        return {}
    return {name: out / ("model.npz" if len(names) == 1 else f"model_{name}.npz") for name in names}


def keep(path: Path, settings: Any, dataset: Any, case: Case, state: Any, seed: int) -> None:
    """Calibrate a trained network on the rows that scored it, and write it.

    Its scores have been taken by then, and calibration moves no prediction: only probabilities and
    the thresholds of dead sensors come from these rows.
    """
    import jax

    from fusion.fitted import finish

    rate = max(FALSE_ALARM_RATE, 1.0 / len(dataset.test_y))
    key = jax.random.key(seed)
    finish(settings.model, state, dataset, case.noise, key=key, false_alarm_rate=rate).save(path)


def kept_sentence(files: Mapping[str, Path], rows: str) -> str:
    """Where the networks are, how to read them, and which rows they have seen."""
    names = ", ".join(map(str, files.values()))
    what = "the network" if len(files) == 1 else "the networks"
    return (
        f"Kept {what} in {names}: read with fusion.FittedARGate.load. Probabilities and failure "
        f"thresholds were calibrated on the {rows} rows, so judge these on rows of another source."
    )
