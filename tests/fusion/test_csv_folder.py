"""A folder of one's own: sensors of unequal shapes, holes, weights of classes, any target."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import failures, sensor_network
from fusion.data.csv_folder import load_folder
from fusion.losses import LossParams, cross_entropy
from fusion.target_scores import SCORES, target_scores

# optax raises a float to a whole power, which strict promotion forbids.
pytestmark = pytest.mark.relaxed

SENSORS = {"imu": ["ax", "ay"], "heat": ["t"]}
CLASSES = {"kind": "classes", "columns": ["activity"]}


def write(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def make(folder: Path, target: dict[str, Any], n: int = 120, **schema: Any) -> Path:
    """Twenty samples of two channels that tell the pace, four of one that tells how warm it is."""
    rng = np.random.default_rng(0)
    pace, warm = rng.integers(0, 2, n), rng.integers(0, 2, n)
    time = np.arange(20) / 20
    imu, heat = [], []
    for i in range(n):
        wave = np.sin(2 * np.pi * (2 + 3 * pace[i]) * time + rng.uniform(0, 6.28))
        imu += [[f"r{i}", 9.8 * w, 300 - 5 * w + 0.1 * rng.normal()] for w in wave]
        heat += [[f"r{i}", 20 + 5 * warm[i] + 0.5 * rng.normal()] for _ in range(4)]
    rows = [
        [f"r{i}", ("walk", "run")[pace[i]], 2.0 * pace[i] - 10 * warm[i], pace[i], warm[i], i // 5]
        for i in range(n)
    ]
    folder.mkdir(exist_ok=True)
    write(folder / "rows.csv", ["id", "activity", "power", "fast", "hot", "person"], rows)
    write(folder / "imu.csv", ["id", "ax", "ay"], imu)
    write(folder / "heat.csv", ["id", "t"], heat)
    (folder / "schema.json").write_text(
        json.dumps({"sensors": SENSORS, "target": target, **schema})
    )
    return folder


def test_sensors_keep_their_own_shapes_and_people_stay_whole(tmp_path: Path) -> None:
    data = load_folder(make(tmp_path, CLASSES, groups="person"))
    assert [x.shape[1:] for x in data.train.readings] == [(2, 20), (1, 4)]
    assert data.names == ("run", "walk") and data.channels == (("ax", "ay"), ("t",))
    assert max(np.abs(x).max() for x in data.train.readings) == 1.0
    people = [{int(name[1:]) // 5 for name in rows.ids} for rows in (data.train, data.test)]
    assert not people[0] & people[1] and len(people[1]) == 6
    part = load_folder(tmp_path, validation=True)
    assert not set(part.test.ids) & set(data.test.ids)
    assert len(part.test.ids) + len(part.train.ids) == len(data.train.ids)


def test_lost_samples_are_filled_and_silent_sensors_are_absent(tmp_path: Path) -> None:
    folder = make(tmp_path, CLASSES)
    lines = (folder / "heat.csv").read_text().splitlines()
    # Row r0 loses its first and third sample, r1 all of them, r2 has no lines.
    lines[1], lines[3] = "r0,", "r0,"
    lines[5:9] = ["r1,"] * 4
    kept = [line for line in lines if not line.startswith("r2,")]
    (folder / "heat.csv").write_text("\n".join(kept) + "\n")
    data = load_folder(folder)
    parts = {name: (part, i) for part in (data.train, data.test) for i, name in enumerate(part.ids)}
    known = [float(lines[i].split(",")[1]) for i in (2, 4)]
    part, i = parts["r0"]
    low, high = (float(v[0]) for v in (data.scales[1].low, data.scales[1].high))
    wanted = [2 * (known[j] - low) / (high - low) - 1 for j in (0, 0, 0, 1)]
    np.testing.assert_allclose(part.readings[1][i, 0], np.clip(wanted, -1, 1), atol=1e-6)
    for name in ("r1", "r2"):
        part, i = parts[name]
        assert part.available[i].tolist() == [True, False] and (part.readings[1][i] == 0).all()


def test_weights_of_classes_have_mean_one_over_the_rows_and_are_in_the_loss(
    tmp_path: Path,
) -> None:
    target = CLASSES | {"class_weights": {"run": 3.0, "walk": 1.0}}
    data = load_folder(make(tmp_path, target))
    weights = data.class_weights
    assert weights is not None
    assert weights[0] / weights[1] == pytest.approx(3.0)
    assert weights[data.train.target].mean() == pytest.approx(1.0)
    net = sensor_network.network(sensor_network.FolderConfig("netgated"), data)
    readings = [jnp.asarray(x[:6]) for x in data.train.readings]
    labels = jnp.asarray(data.train.target[:6])
    variables = net.init(jax.random.key(0), LossParams(), readings, labels)
    terms: Any = net.apply(variables, LossParams(), readings, labels)
    out: Any = net.model.apply({"params": variables["params"]["model"]}, readings)
    by_hand = (weights[np.asarray(labels)] * cross_entropy(out.output, labels)).mean()
    assert float(terms.main) == pytest.approx(float(by_hand), rel=1e-5)
    balanced = load_folder(make(tmp_path, CLASSES | {"class_weights": "balanced"}))
    counts = np.bincount(balanced.train.target)
    np.testing.assert_allclose(balanced.class_weights, counts.sum() / (2 * counts), rtol=1e-6)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("schema.json", ('"classes"', '"class"'), "target.kind='class': expected one of"),
        ("schema.json", ('"sensors"', '"sensor"'), "'sensors'"),
        ("imu.csv", ("r3,", "x3,"), "imu.csv, line 62: id 'x3' is not in rows.csv"),
        ("heat.csv", ("r3,", "r3,warm"), "heat.csv, line 14: t is 'warm"),
        ("rows.csv", ("r3,", "r4,"), "a different id in each row"),
        ("rows.csv", ("activity", "name"), "columns .'activity'. are missing"),
    ],
)
def test_what_does_not_fit_is_named_with_its_place(
    tmp_path: Path, file: str, change: tuple[str, str], message: str
) -> None:
    path = make(tmp_path, CLASSES) / file
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(ValueError, match=message):
        load_folder(tmp_path)


def test_windows_of_two_lengths_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = make(tmp_path, CLASSES) / "heat.csv"
    path.write_text(path.read_text() + "r3,20.0\n")
    with pytest.raises(ValueError, match=r"windows of \[4, 5\] samples"):
        load_folder(tmp_path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"heat.csv: no such file"):
        load_folder(tmp_path)


def test_the_channels_of_a_sensor_fail_together() -> None:
    readings = (jnp.full((60, 2, 5), 0.5), jnp.full((60, 3, 2), 0.5))
    protocol = failures.random_failing(("a", "b"), 1)
    noisy, failed = sensor_network.corrupt_sensors(
        protocol, readings, "zero", key=jax.random.key(0)
    )
    assert failed.sum() == 40 and failed.sum(axis=0).min() > 5
    for s, x in enumerate(noisy):
        dead = np.asarray(x == 0.0).reshape(60, -1)
        np.testing.assert_array_equal(dead.all(axis=1), failed[:, s])
        np.testing.assert_array_equal(dead.any(axis=1), failed[:, s])


def test_scores_equal_those_of_another_library() -> None:
    metrics = pytest.importorskip("sklearn.metrics", reason="compares with scikit-learn")
    rng = np.random.default_rng(1)
    failed = rng.random((50, 2)) < 0.2
    out, y = rng.normal(size=(50, 3)), rng.integers(0, 3, 50)
    found = target_scores("classes", out, y, failed)
    assert found["balanced_accuracy"] == pytest.approx(
        100 * metrics.balanced_accuracy_score(y, out.argmax(1))
    )
    some = ~failed.any(axis=1)
    assert found["accuracy_clean"] == pytest.approx(100 * (out.argmax(1) == y)[some].mean())
    goal = rng.normal(size=(50, 3))
    found = target_scores("numbers", out, goal, failed)
    assert found["explained"] == pytest.approx(100 * metrics.r2_score(goal, out))
    assert found["rmse"] == pytest.approx(metrics.mean_squared_error(goal, out) ** 0.5)
    labels = (goal > 0).astype(float)
    found = target_scores("labels", out, labels, failed)
    assert found["macro_f1"] == pytest.approx(
        100 * metrics.f1_score(labels, out > 0, average="macro")
    )
    assert found["exact"] == pytest.approx(100 * metrics.accuracy_score(labels, out > 0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "least"),
    [
        (CLASSES, 90.0),
        ({"kind": "numbers", "columns": ["power", "fast"]}, 75.0),
        ({"kind": "labels", "columns": ["fast", "hot"]}, 90.0),
    ],
)
def test_each_kind_of_target_is_learned(
    tmp_path: Path, target: dict[str, Any], least: float
) -> None:
    data = load_folder(make(tmp_path, target, n=240))
    config = sensor_network.FolderConfig("argate_l", epochs=25)
    clean = failures.no_failure(data.sensors)
    key = jax.random.key(0)
    fitted = sensor_network.fit(config, data, clean, key=key)
    found = sensor_network.run(config, fitted.params, data, clean, key=key)
    scores = target_scores(data.kind, found.output, found.target, found.failed)
    assert scores[next(iter(SCORES[data.kind]))] > least


@pytest.mark.slow
def test_the_gate_learns_to_leave_failed_sensors_out(tmp_path: Path) -> None:
    data = load_folder(make(tmp_path, {"kind": "labels", "columns": ["fast", "hot"]}, n=240))
    protocol, key = failures.random_failing(data.sensors, 1), jax.random.key(0)
    for model in ("argate_plus", "equal_weights"):
        config = sensor_network.FolderConfig(model, epochs=25)
        fitted = sensor_network.fit(config, data, protocol, key=key)
        found = sensor_network.run(config, fitted.params, data, protocol, key=key)
        gap = found.weights[~found.failed].mean() - found.weights[found.failed].mean()
        assert gap > 0.1 if model == "argate_plus" else abs(gap) < 1e-6
