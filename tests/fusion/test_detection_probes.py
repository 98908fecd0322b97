"""What a linear reader finds, and which bodies it is asked about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from fusion.detection.probes import probe_auroc, read_bodies
from fusion.detection.settings import detector_preset

CONFIG = detector_preset("tiny")
HEADER = (
    "label,kind,points,pixels,share,dark_paint,low_contrast,night,x,y,z,length,width,height,"
    "rotation_y\n"
)


def test_linear_reader_finds_what_is_linear_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(0)
    car = rng.uniform(size=400) < 0.6
    noise = rng.standard_normal((400, 12))
    assert 0.4 < probe_auroc(noise, car) < 0.6
    told = noise + 1.5 * car[:, None] * np.eye(12)[3]
    found = probe_auroc(told, car)
    # No reader beats the direction along which the classes differ.
    best = mannwhitneyu(told[200:, 3][car[200:]], told[200:, 3][~car[200:]]).statistic
    best /= car[200:].sum() * (~car[200:]).sum()
    assert best - 0.06 < found < best + 0.02
    assert np.isnan(probe_auroc(told, np.ones(400, bool)))


def test_bodies_that_both_sensors_see(tmp_path: Path) -> None:
    path = tmp_path / "000000.csv"
    rows = [
        "0,Car,50,80.00,0.900,0,0,0,1.5,1.6,12.0,4.0,1.6,1.5,0.3",
        "-1,bush,30,40.00,0.800,0,0,0,-2.0,1.6,9.0,3.9,1.5,1.4,1.5",
        "1,Car,2,80.00,0.900,0,0,0,1.0,1.6,15.0,4.0,1.6,1.5,0.0",  # too few points
        "2,Car,50,80.00,0.200,0,0,0,1.0,1.6,16.0,4.0,1.6,1.5,0.0",  # hidden
        "3,Car,50,80.00,0.900,0,0,0,1.0,1.6,90.0,4.0,1.6,1.5,0.0",  # outside the area
        "4,Cyclist,50,80.00,0.900,0,0,0,1.0,1.6,14.0,1.8,0.6,1.7,0.0",
    ]
    path.write_text(HEADER + "\n".join(rows) + "\n")
    bodies = read_bodies(path, CONFIG)
    assert bodies.mask.tolist() == [True, True, False, False]
    assert bodies.car.tolist() == [True, False, False, False]
    np.testing.assert_allclose(bodies.boxes[0], [1.5, 1.6, 12.0, 4.0, 1.6, 1.5, 0.3], rtol=1e-6)
    path.write_text("label,kind\n0,Car\n")
    with pytest.raises(ValueError, match=r"000000\.csv: no column rotation_y; simulate"):
        read_bodies(path, CONFIG)
