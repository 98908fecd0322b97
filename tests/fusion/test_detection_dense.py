"""The one-stage detector: grid, targets and their inverse, parameters, a few steps in the loop."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.config import DenseConfig, DetectorConfig
from fusion.detection.geometry.bev import BevConfig
from fusion.detection.kitti.objects import concatenate, select
from fusion.detection.learning.dense_objective import dense_loss, grid_losses
from fusion.detection.learning.dense_targets import (
    GridTargets,
    average_cells,
    decode_cells,
    grid_targets,
    ignored_cells,
)
from fusion.detection.learning.examples import make_example, make_inputs
from fusion.detection.learning.fitting import fit_detector, run_detector
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.training import DetectorTrainConfig, fail_sensor
from fusion.detection.network.build import count_main_parameters, init_detector
from fusion.detection.network.dense import N_OUTPUTS, DenseDetector
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.lifting import grid_centres, lift
from fusion.detection.presets import preset
from fusion.targets import check_targets
from tests.fusion.test_detection_network import a_frame

TINY = preset("tiny", "dense_argate").config
PLANE = jnp.array([0.0, -1.0, 0.0, 1.6])


def test_cells_lie_as_the_map_does() -> None:
    x, z = grid_centres(TINY)
    assert x.shape == z.shape == (32, 32)
    assert (x[0, 0], z[0, 0], x[-1, -1], z[-1, -1]) == (-7.75, 19.75, 7.75, 4.25)
    with pytest.raises(ValueError, match=r"cell=0\.75: expected a multiple of the map's 0\.5 m"):
        dataclasses.replace(TINY, dense=DenseConfig(cell=0.75))
    with pytest.raises(ValueError, match="expected multiples of 4"):
        DenseConfig(lidar_width=6)
    with pytest.raises(ValueError, match="divides its 31 x 32 cells"):
        area = BevConfig(x_range=(-8.0, 8.0), z_range=(4.5, 20.0), cell=0.5)
        DetectorConfig(model="dense", bev=area, dense=DenseConfig(cell=1.0))


def test_lifted_features_are_those_of_the_projected_cells() -> None:
    rows, columns = 16, 48
    u, v = jnp.meshgrid(jnp.linspace(0, 1, columns), jnp.linspace(0, 1, rows))
    p2 = jnp.array([[70.0, 0, 48, 0], [0, 70, 16, 0], [0, 0, 1, 0]])
    size = jnp.array([32.0, 96.0])
    got = jax.jit(partial(lift, TINY))(jnp.stack([u, v], axis=-1), PLANE, p2, size)
    assert got.shape == (32, 32, 6)
    x, z = grid_centres(TINY)
    for k, above in enumerate(TINY.dense.heights):
        wanted_u = (70 * x / z + 48) / 95
        wanted_v = (70 * (1.6 - above) / z + 16) / 31
        inside = (wanted_u >= 0) & (wanted_u <= 1) & (wanted_v >= 0) & (wanted_v <= 1)
        assert 100 < inside.sum() < inside.size
        np.testing.assert_allclose(got[..., 2 * k][inside], wanted_u[inside], atol=1e-4)
        np.testing.assert_allclose(got[..., 2 * k + 1][inside], wanted_v[inside], atol=1e-4)
        assert float(jnp.abs(got[..., 2 * k][~inside]).max()) == 0.0


def _inputs(truth: jax.Array, mask: jax.Array, **more: jax.Array) -> Inputs:
    """What targets read of a frame; the rest is not there."""
    none = jnp.zeros(0)
    p2 = jnp.array([[70.0, 0, 48, 0], [0, 70, 16, 0], [0, 0, 1, 0]])
    known = {"ignored": jnp.zeros(len(truth), bool), "regions": jnp.zeros((2, 4))} | more
    return Inputs(
        image=none, bev=none, anchors=none, anchor_mask=none, n_occupied=none, p2=p2,
        image_size=jnp.array([32.0, 96.0]), plane=PLANE, truth=truth, truth_mask=mask, told=none,
        **known,
    )  # fmt: skip


def test_targets_decode_to_the_labels() -> None:
    truth = jnp.array([[-2.4, 1.5, 9.4, 4.2, 1.7, 1.5, 0.3], [3.4, 1.6, 14.6, 3.6, 1.6, 1.4, -2.0],
                       [0.0, 0, 0, 1, 1, 1, 0]])  # fmt: skip
    mask = jnp.array([True, True, False])
    targets = jax.jit(partial(grid_targets, TINY))
    got = targets(_inputs(truth, mask))
    assert int(got.centre.sum()) == 2 and float(got.heat.max()) == 1.0
    assert 8 < int(got.near.sum()) < 30 and float(got.heat[0, 0]) < 1e-6
    assert not got.ignored.any()
    cells = [int((20 - z) / 0.5) * 32 + int((x + 8) / 0.5) for x, z in truth[:2, [0, 2]].tolist()]
    assert got.centre.ravel()[jnp.array(cells)].all()
    boxes = decode_cells(TINY, got.boxes, PLANE)
    np.testing.assert_allclose(boxes[jnp.array(cells)], truth[:2], atol=1e-4)
    none = targets(_inputs(truth, jnp.zeros(3, bool)))
    assert float(none.heat.max()) == 0.0 and not bool(none.near.any())


def test_an_axis_is_told_apart_from_its_direction() -> None:
    # A network that cannot tell front from back: the mean of a car and of the car turned round.
    truth = jnp.array([[-2.4, 1.5, 9.4, 4.2, 1.7, 1.5, 1.2]])
    mask, cell = jnp.ones(1, bool), int((20 - 9.4) / 0.5) * 32 + int((8 - 2.4) / 0.5)
    turned = truth.at[:, 6].add(jnp.pi)
    told = [grid_targets(TINY, _inputs(t, mask)).boxes for t in (truth, turned)]
    np.testing.assert_allclose(told[0][..., :8], told[1][..., :8], atol=1e-6)
    unsure = 0.5 * told[0] + 0.5 * told[1]
    for towards, heading in ((1e-3, 1.2), (-1e-3, 1.2 - np.pi)):
        found = decode_cells(TINY, unsure + towards * told[0], PLANE)[cell]
        np.testing.assert_allclose(found[6], heading, atol=1e-3)


def test_boxes_are_means_over_the_cells_around_a_peak() -> None:
    truth = jnp.array([[-2.4, 1.5, 9.4, 4.2, 1.7, 1.5, 1.2]])
    row, column = int((20 - 9.4) / 0.5), int((8 - 2.4) / 0.5)
    told = grid_targets(TINY, _inputs(truth, jnp.ones(1, bool))).boxes
    heat = jnp.full((32, 32, 1), -9.0).at[row, column].set(3.0).at[row, column + 1].set(3.0)
    error = jnp.zeros_like(told).at[row, column, 0].set(0.6)  # this cell is 0.6 m wrong in x
    mean = jax.jit(partial(average_cells, TINY))(jnp.concatenate([heat, told + error], axis=-1))
    np.testing.assert_array_equal(mean[..., :1], heat)
    found = decode_cells(TINY, mean[..., 1:], PLANE)[row * 32 + column]
    # Two cells count, and the other one is right.
    np.testing.assert_allclose(found, truth[0].at[0].add(0.3), atol=2e-3)


def test_vans_and_regions_that_nobody_labelled_are_neither_cars_nor_background() -> None:
    truth = jnp.array([[-2.4, 1.6, 9.4, 4.2, 1.7, 1.5, 0.0], [3.4, 1.6, 14.6, 5.0, 2.0, 2.2, 1.57]])
    car, van = jnp.array([True, False]), jnp.array([False, True])
    u, v = 70 * 5.75 / 18.25 + 48, 70 * 0.8 / 18.25 + 16  # of the cell at (5.75, 18.25)
    region = jnp.array([[u - 0.5, v - 0.05, u + 0.5, v + 0.05], [0, 0, 0, 0]])
    got = grid_targets(TINY, _inputs(truth, car, ignored=van, regions=region))
    assert int(got.centre.sum()) == 1
    x, z = grid_centres(TINY)
    on_van = (np.abs(x - 3.4) < 1.4) & (np.abs(z - 14.6) < 2.9)
    in_region = (x == 5.75) & (z == 18.25)
    assert got.ignored[on_van].all() and got.ignored[in_region].all()
    assert not got.ignored[(np.abs(x - 3.4) > 1.6) & (z < 17)].any()
    targets = jax.tree.map(lambda a: a[None], got)
    outputs = jnp.zeros((1, 32, 32, N_OUTPUTS))
    ghost = outputs.at[0, ..., 0].set(jnp.where(got.ignored, 9.0, 0.0))
    for before, after in zip(*(grid_losses(o, targets) for o in (outputs, ghost)), strict=True):
        np.testing.assert_allclose(before, after, rtol=1e-6)


def test_frames_hold_vans_and_regions_which_are_mirrored() -> None:
    frame = a_frame()
    labels = frame.labels
    assert labels is not None
    labels.type[:] = ["Van", "Car"]
    both = concatenate([labels, select(labels, np.array([0]))])
    both.type[2], both.bbox[2] = "DontCare", (10.0, 6.0, 30.0, 14.0)
    example, _ = make_example(TINY, frame._replace(labels=both))
    assert example.truth_mask.tolist() == [True, False, False, False]
    assert example.ignored.tolist() == [False, True, False, False]
    np.testing.assert_allclose(example.truth[:2, 0], [3.4, -2.4], rtol=1e-6)
    np.testing.assert_array_equal(example.regions[0], [10, 6, 30, 14])
    read = jax.jit(lambda mirror: make_inputs(TINY, example, mirror=mirror))
    plain, mirrored = read(jnp.array(False)), read(jnp.array(True))
    np.testing.assert_array_equal(mirrored.regions[0], [65, 6, 85, 14])
    np.testing.assert_array_equal(mirrored.regions[1:], 0)
    cells = jax.jit(partial(ignored_cells, TINY))
    there = cells(plain)
    assert there.any()
    np.testing.assert_array_equal(cells(mirrored), there[:, ::-1])


def test_losses_by_hand() -> None:
    heat = jnp.array([[[1.0, 0.5], [0.0, 0.0]]])
    centre = heat == 1.0
    boxes = jnp.zeros((1, 2, 2, N_OUTPUTS - 1))
    targets = GridTargets(heat, centre, centre, boxes, jnp.zeros_like(centre))
    outputs = jnp.zeros((1, 2, 2, N_OUTPUTS)).at[0, 0, 0, 1].set(2.0)
    got = grid_losses(outputs, targets)
    # Heat 0.5 everywhere: 1/4 log 2 for the centre and for cold cells, a 16th of it beside it.
    np.testing.assert_allclose(got[0], 0.25 * np.log(2) * (1 + 2 + 0.5**4), rtol=1e-5)
    np.testing.assert_allclose(got[1], 2.0, rtol=1e-6)
    np.testing.assert_allclose(got[2], np.log(2), rtol=1e-5)


def test_the_gate_adds_less_than_two_percent() -> None:
    for size in ("paper", "small"):
        plain, gated, oracle = (
            count_main_parameters(preset(size, m).config)
            for m in ("dense", "dense_argate", "dense_oracle")
        )
        assert plain < gated < 1.02 * plain and plain < oracle < 1.02 * plain


def test_few_training_frames_lack_a_view() -> None:
    for model in ("dense", "dense_argate", "dense_oracle"):
        assert preset("small", model).config.path_drop == 0.1
        assert not preset("small", model).config.auxiliary_trains_views
    assert preset("small", "avod").config.path_drop == 0.3


@pytest.mark.slow
def test_only_the_oracle_is_told() -> None:
    example, _ = make_example(TINY, a_frame())
    fail = jax.jit(lambda key: fail_sensor(TINY, example, "lidar_noise", 0.5, key=key))
    failing = jax.tree.map(lambda a: a[None], fail(jax.random.key(1)))
    np.testing.assert_array_equal(failing.told, [[0.0, 0.5]])
    works = failing._replace(told=jnp.zeros((1, 2)))
    for model in ("dense_argate", "dense_oracle"):
        config = dataclasses.replace(TINY, model=model)
        params, _ = jax.jit(partial(init_detector, config=config))(jax.random.key(0))
        gate = params["main"]["gate"]["fusion"]
        gate["kernel"] = jax.random.normal(jax.random.key(2), gate["kernel"].shape)
        weigh = jax.jit(partial(DenseDetector(config).apply, method="encode"))
        weights = [weigh({"params": params["main"]}, x).weights for x in (works, failing)]
        np.testing.assert_allclose(weights[0].sum(), 1.0, rtol=1e-5)
        assert np.array_equal(*weights) == (model == "dense_argate")
    fixed = dataclasses.replace(config, fixed_weights=(1.0, 0.0))
    weigh = jax.jit(partial(DenseDetector(fixed).apply, method="encode"))
    alone = weigh({"params": params["main"]}, works)
    np.testing.assert_array_equal(alone.weights, [[1.0, 0.0]])
    with pytest.raises(ValueError, match="expected none with model='avod'"):
        dataclasses.replace(TINY, model="avod", fixed_weights=(1.0, 0.0))


@pytest.mark.slow
def test_low_precision_is_the_same_network_rounded() -> None:
    example, _ = make_example(TINY, a_frame())
    config = dataclasses.replace(TINY, model="dense")
    x = jax.tree.map(lambda a: a[None], jax.jit(partial(make_inputs, config))(example))
    params, _ = jax.jit(partial(init_detector, config=config))(jax.random.key(0))
    # Outputs start near zero.
    main = jax.tree.map(lambda a: a + 0.1 * jnp.sin(jnp.arange(a.size)).reshape(a.shape),
                        params["main"])  # fmt: skip

    def run(precision: str) -> np.ndarray:
        network = DenseDetector(dataclasses.replace(config, precision=precision))
        found = jax.jit(network.apply)({"params": main}, x)
        assert found.dtype == jnp.float32
        return np.asarray(found)

    exact, low = run("float32"), run("bfloat16")
    error = np.abs(exact - low)
    # Eight bits of mantissa: a rounding of 0.4 % in every layer.
    assert 1e-4 < error.max() < 0.05 and np.abs(exact).max() > 1.0


@pytest.mark.slow
def test_auxiliary_losses_train_the_views_only_where_they_are_asked_to() -> None:
    example, _ = make_example(TINY, a_frame())
    x = jax.tree.map(lambda a: a[None], jax.jit(partial(make_inputs, TINY))(example))
    rates = DetectorParams()
    for trains in (True, False):
        config = dataclasses.replace(TINY, auxiliary_trains_views=trains)
        params, stats = jax.jit(partial(init_detector, config=config))(jax.random.key(0))
        loss = jax.grad(partial(dense_loss, config), argnums=1, has_aux=True)
        slope = jax.jit(partial(loss, stats=stats, inputs=x, key=jax.random.key(1)))
        whole, without = (
            slope(rates._replace(gate=rates.gate._replace(alpha=alpha)), params)[0]
            for alpha in (1.0, 0.0)
        )
        same = jax.tree.map(np.array_equal, whole["main"]["near_0"], without["main"]["near_0"])
        assert all(jax.tree.leaves(same)) != trains
        heads = jax.tree.leaves(whole["auxiliary"])
        assert any(np.abs(leaf).max() > 0 for leaf in heads)
    with pytest.raises(ValueError, match="expected True with model='avod_argate'"):
        dataclasses.replace(TINY, model="avod_argate", auxiliary_trains_views=False)


@pytest.mark.relaxed
@pytest.mark.slow
def test_it_is_trained_by_the_same_loop() -> None:
    example, _ = make_example(TINY, a_frame())
    train = DetectorTrainConfig(
        steps=30, batch_size=2, schedule="cosine", failure_share=0.5, flip=False,
        failure_kinds=("camera_noise", "lidar_loss"),
    )  # fmt: skip
    rates = DetectorParams(learning_rate=1e-2, l2=0.0, l2_dense=0.0, clip_norm=5.0)
    fitted = fit_detector(TINY, train, rates, 3, lambda i: example, seed=1, report_every=10)
    first, last = fitted.history[0], fitted.history[-1]
    assert np.isfinite(list(last.values())).all()
    assert last["classes"] < 0.7 * first["classes"] and last["boxes"] < first["boxes"]
    assert first["positives"] == 2.0 and last["auxiliary"] < first["auxiliary"]
    assert float(check_targets(TINY.targets, fitted.state.params["targets"])) == 0.0
    config = dataclasses.replace(TINY, score_threshold=0.0)
    (found,) = run_detector(config, fitted.state, [example])
    assert found.boxes.shape == (4, 7) and found.mask.any() and np.isfinite(found.boxes).all()
    np.testing.assert_allclose(found.weights.sum(), 1.0, rtol=1e-5)
    assert ((found.failed > 0) & (found.failed < 1)).all()
    assert (np.diff(found.scores[found.mask]) <= 0).all()
    (dead,) = run_detector(config, fitted.state, [example], failure="lidar_loss")
    assert not np.array_equal(dead.scores, found.scores)
