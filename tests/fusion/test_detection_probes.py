"""What a linear reader finds, and which bodies it is asked about."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from fusion.detection.network.build import init_detector
from fusion.detection.network.inputs import Inputs
from fusion.detection.presets import preset
from tests._scripts import load_script

study = load_script("studies/study_views")
probe_auroc, read_bodies, read_views = study.probe_auroc, study.read_bodies, study.read_views

CONFIG = preset("tiny").config
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


@pytest.mark.slow
def test_crops_are_those_of_the_boxes() -> None:
    rows, columns = CONFIG.image_size
    # A picture whose red is the column and whose green is the row, both from 0 to 1.
    red = jnp.broadcast_to(jnp.linspace(0, 1, columns)[None], (rows, columns))
    green = jnp.broadcast_to(jnp.linspace(0, 1, rows)[:, None], (rows, columns))
    none = jnp.zeros(1)
    inputs = Inputs(
        image=jnp.stack([red, green, red], axis=-1),
        bev=jnp.zeros((*CONFIG.bev.shape, CONFIG.bev.n_slices + 1)),
        anchors=none, anchor_mask=none, n_occupied=none,
        p2=jnp.array([[40.0, 0, 48, 0], [0, 40, 16, 0], [0, 0, 1, 0]]),
        image_size=jnp.array([32.0, 96.0]), plane=none, truth=none, truth_mask=none,
        ignored=none, regions=none, told=none,
    )  # fmt: skip
    boxes = jnp.array([[-3.0, 1.6, 12, 4, 1.6, 1.5, 0.0], [4.0, 1.6, 16, 4, 1.6, 1.5, 1.57]])
    params, stats = jax.jit(partial(init_detector, config=CONFIG))(jax.random.key(0))
    read = jax.jit(partial(read_views, CONFIG))
    got = read(params["main"], stats, inputs=inputs, boxes=boxes)
    pixels = got.pixels.reshape(2, 3, 3, 3)
    # The middle of a box lies at its centre's projection, to the depth's perspective.
    u = (40 * boxes[:, 0] / boxes[:, 2] + 48) / 95
    v = (40 * (boxes[:, 1] - 0.75) / boxes[:, 2] + 16) / 31
    np.testing.assert_allclose(pixels[:, 1, 1, 0], u, atol=0.03)
    np.testing.assert_allclose(pixels[:, 1, 1, 1], v, atol=0.03)
    assert (np.diff(pixels[:, 1, :, 0], axis=1) > 0.02).all()
    assert got.second.shape == got.first.shape == (2,)
    assert np.isfinite(got.second).all() and np.ptp(got.camera) > 0
    # A box is read the same beside any others.
    alone = read(params["main"], stats, inputs=inputs, boxes=boxes[::-1])
    np.testing.assert_allclose(alone.second, got.second[::-1], atol=1e-5)
