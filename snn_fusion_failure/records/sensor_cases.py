"""Rows and columns of the studies beside Tables 3.1 to 3.6 (`study_sensors`)."""

from __future__ import annotations

import dataclasses
from typing import Any

KINDS = ("uniform", "gaussian", "zero", "stuck", "drift", "dropout", "gain", "clip")


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: options of `train_argate`, the kind in test where it is another, the columns."""

    name: str
    options: dict[str, Any]
    models: tuple[str, ...]
    test_kind: str | None = None


def _driver(name: str, n_clean: int, models: tuple[str, ...], **options: Any) -> Case:
    given = {"dataset": "driver", "protocol": "random", "n_clean": n_clean, **options}
    return Case(name, given, models)


_COLUMNS = (
    *("equal_weights", "netgated", "argate_plus", "argate_l", "argate_plus_printed"),
    *("argate_l_printed", "oracle", "forest_ceiling", "nearest_rows", "linear_fit"),
)


def _grid(**options: Any) -> list[Case]:
    """Few and many failing sensors, both noises, all columns."""
    return [
        _driver(f"n_clean={n} {kind}", n, _COLUMNS, kind=kind, **options)
        for kind in ("uniform", "gaussian")
        for n in (12, 8, 5)
    ]


def _long(name: str, n_clean: int, *bounds: str) -> Case:
    """Four times the epochs of the preset: with few clean sensors each is seldom seen alone.

    `dedicated` keeps the preset's.
    """
    options = {"dataset": "har", "protocol": "random", "n_clean": n_clean, "epochs": 60}
    columns = ("baseline", "argate_plus", "argate_l", "oracle", *bounds)
    return Case(name, options, (*columns, "nearest_rows", "linear_fit"))


_GATES = {
    "as in the preset": (),
    "kl": ("model.loss.imitation=kl",),
    "held out": ("model.loss.target_training=held_out",),
    "kl, held out": ("model.loss.imitation=kl", "model.loss.target_training=held_out"),
    "experts": ("model.loss.target_training=experts",),
    "kl, experts": ("model.loss.imitation=kl", "model.loss.target_training=experts"),
    "masks": ("model.loss.mask_supervision=true",),
}


_TWO = ("equal_weights", "argate_plus")


def _without_flag(n_clean: int, kind: str) -> list[Case]:
    changes = ("model.encoder.known_readings=false",)
    return [
        _driver(f"n_clean={n_clean} {kind}", n_clean, _TWO, kind=kind),
        _driver(
            f"n_clean={n_clean} {kind}, feature off", n_clean, _TWO, kind=kind, changes=changes
        ),
    ]


STUDIES: dict[str, tuple[str, list[Case]]] = {
    "driver_heads": (
        "Driver identification without a signal that names trips, neighbourhood head, accuracy %",
        _grid(),
    ),
    "driver_trip": (
        "Driver identification, whole trips held out, accuracy %",
        _grid(split="trip"),
    ),
    "driver_tagged": (
        "Driver identification with a signal that names trips, accuracy %",
        _grid(features="tagged"),
    ),
    "known_readings": (
        "Driver identification, failed sensors that go on sending known readings, accuracy %",
        [case for kind in ("uniform", "stuck", "zero") for case in _without_flag(8, kind)],
    ),
    "kept_out_kinds": (
        "HAR trained on all kinds of failure but the one of the test, n_clean=5, accuracy %",
        [
            Case(
                kept,
                {"dataset": "har", "protocol": "random", "n_clean": 5}
                | {"kind": ",".join(k for k in KINDS if k != kept)},
                ("baseline", "argate_plus"),
                kept,
            )
            for kept in KINDS
        ],
    ),
    "har_long": (
        "HAR, trainings of 60 epochs instead of 15, accuracy %",
        [_long("n_clean=5 uniform", 5), _long("n_clean=1 uniform", 1, "dedicated")],
    ),
    "gate_targets": (
        "What the gate of ARGate-L learns from, HAR, validation subjects, accuracy %",
        [
            Case(
                name,
                {"dataset": "har", "protocol": "random", "n_clean": 5, "validation": True}
                | {"changes": changes},
                ("argate_l",),
            )
            for name, changes in _GATES.items()
        ],
    ),
}


PAIRS = (
    *((m, "equal_weights") for m in (*_COLUMNS[1:6], "oracle")),
    ("argate_l", "argate_plus"),
    *((m, "baseline") for m in ("argate_plus", "argate_l")),
    *((m, f"{m}_printed") for m in ("argate_plus", "argate_l")),
)
"""Columns that are compared seed by seed."""
