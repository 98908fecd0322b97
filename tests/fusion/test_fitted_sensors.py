"""A network of a folder's sensors in use: raw windows, missing sensors, one file, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.data.csv_folder import SensorFolder, assemble, read_windows
from fusion.failures import no_failure
from fusion.fitted_sensors import FittedSensors, finish_sensors
from fusion.losses import LossParams
from fusion.sensor_network import FolderConfig, network, run

pytestmark = pytest.mark.relaxed

SENSORS = {"imu": ("ax", "ay"), "heat": ("t",)}
CONFIG = FolderConfig("argate_l", features=4, width=4)
RNG = np.random.default_rng(0)
IMU = 9.81 * RNG.normal(size=(12, 2, 5))
HEAT = 300.0 + 10.0 * RNG.normal(size=(12, 1, 1))
HEAT[3] = np.nan
RAW = [IMU, HEAT]
TEST = np.arange(12) >= 8
TARGETS = {
    "classes": (("rest", "walk"), np.arange(12) % 2),
    "numbers": (("speed", "heart"), 50.0 + RNG.normal(size=(12, 2))),
    "labels": (("loud", "hot"), (RNG.normal(size=(12, 2)) > 0).astype(np.float32)),
}


def made(kind: str) -> tuple[SensorFolder, dict]:
    """Rows of a folder, and parameters as they are drawn."""
    names, target = TARGETS[kind]
    schema = {"sensors": SENSORS, "target": {"kind": kind, "class_weights": None}}
    data = assemble(schema, names, np.arange(12), RAW, target, ~TEST, TEST)
    rows = data.train
    readings = [jnp.asarray(x[:1]) for x in rows.readings]
    one = readings, jnp.asarray(rows.target[:1]), jnp.asarray(rows.available[:1])
    return data, network(CONFIG, data).init(jax.random.key(0), LossParams(), *one)["params"]


@pytest.mark.parametrize("kind", TARGETS)
def test_raw_windows_give_what_the_test_rows_gave(kind: str, tmp_path: Path) -> None:
    data, params = made(kind)
    finish_sensors(CONFIG, params, data).save(tmp_path / "net.npz")
    with np.load(tmp_path / "net.npz", allow_pickle=False) as file:
        held = list(file.files)
    assert not [n for n in held if "auxiliary" in n or "targets" in n]
    fitted = FittedSensors.load(tmp_path / "net.npz")
    assert dataclasses.astuple(fitted.config) == dataclasses.astuple(CONFIG)
    found = fitted.predict([x[TEST] for x in RAW])
    key = jax.random.key(1)
    expected = run(CONFIG, params, data, no_failure(data.sensors), key=key)
    np.testing.assert_allclose(found.weights, expected.weights, atol=1e-6)
    output = expected.output
    if kind == "classes":
        output = np.exp(output) / np.exp(output).sum(-1, keepdims=True)
    elif kind == "labels":
        output = 1.0 / (1.0 + np.exp(-output))
    np.testing.assert_allclose(found.output, output, rtol=1e-5)


def test_absent_and_implausible_sensors() -> None:
    data, params = made("classes")
    fitted = finish_sensors(CONFIG, params, data)
    found = fitted.predict(RAW)
    assert found.available[:, 0].all() and np.flatnonzero(~found.available[:, 1]).tolist() == [3]
    assert found.weights[3].tolist() == [1.0, 0.0] and not found.out_of_range[:8].any()
    there = np.ones((12, 2), bool)
    there[0, 0] = False
    wild = [IMU.copy(), HEAT.copy()]
    wild[0][0] = 1e9
    hidden = fitted.predict(wild, available=there)
    np.testing.assert_allclose(hidden.output[1:], found.output[1:], rtol=1e-6)
    assert hidden.weights[0].tolist() == [0.0, 1.0] and not hidden.out_of_range[0, 0]
    assert fitted.predict(wild).out_of_range[0].tolist() == [True, False]


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    data, params = made("classes")
    fitted = finish_sensors(CONFIG, params, data)
    infinite = IMU.copy()
    infinite[2, 0, 1] = np.inf
    for readings, message in (
        (RAW[:1], r"readings=1 sensors: expected \['imu', 'heat'\]"),
        ([IMU[:, :1], HEAT], r"readings\['imu'\].shape=\(12, 1, 5\): expected \(12, 2, 5\)"),
        ([IMU, HEAT[:3]], r"readings\['heat'\].shape=\(3, 1, 1\): expected \(12, 1, 1\)"),
        ([infinite, HEAT], r"readings\['imu'\]=windows with infinity"),
    ):
        with pytest.raises(ValueError, match=message):
            fitted.predict(readings)
    np.savez(tmp_path / "other.npz", a=np.ones(2))
    with pytest.raises(ValueError, match=r"other\.npz'"):
        FittedSensors.load(tmp_path / "other.npz")


def test_new_rows_of_a_folder_need_no_target(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("id\nb\na\n")
    (tmp_path / "imu.csv").write_text("id,ax,ay\na,1,2\na,3,\nb,5,6\nb,7,8\n")
    (tmp_path / "heat.csv").write_text("id,t\na,300\n")
    ids, (imu, heat) = read_windows(tmp_path, SENSORS)
    assert ids == ["b", "a"] and imu.tolist() == [[[5, 7], [6, 8]], [[1, 3], [2, 2]]]
    assert np.isnan(heat[0]).all() and heat[1].tolist() == [[300.0]]
