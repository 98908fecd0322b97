"""Networks, mini-batches and losses of the detector: oracles, parameter counts, a few steps."""

from __future__ import annotations

import dataclasses
import signal
from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import box3d_to_box4c, box_corners, project_boxes
from fusion.detection.geometry.planes import PlaneConfig
from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.files import Frame
from fusion.detection.kitti.objects import Objects
from fusion.detection.learning import fitting
from fusion.detection.learning.augmentation import flip
from fusion.detection.learning.detection_loss import (
    balanced_class_loss,
    class_loss,
    regression_loss,
)
from fusion.detection.learning.examples import (
    Example,
    make_example,
    make_inputs,
    stack_examples,
)
from fusion.detection.learning.fitting import (
    fit_detector,
    frame_order,
    restore_detector,
    run_detector,
)
from fusion.detection.learning.gate_objective import gate_terms, path_losses
from fusion.detection.learning.inference import to_objects
from fusion.detection.learning.params import DetectorParams
from fusion.detection.learning.sampling import Assignment, Sample, assign, draw
from fusion.detection.learning.scoring import class_precision, image_scale, weight_auroc
from fusion.detection.learning.training import (
    SENSOR_FAILURES,
    DetectorTrainConfig,
    learning_rate,
)
from fusion.detection.network.build import count_main_parameters, init_detector
from fusion.detection.network.convolution import convolve, low_convolve
from fusion.detection.network.detector import fuse
from fusion.detection.network.group_norm import GROUP_SIZE, group_norm_relu
from fusion.detection.network.proposals import Detections, anchor_boxes, decode_second, final_boxes
from fusion.detection.network.views import TransposedConv
from fusion.detection.presets import preset
from fusion.targets import check_targets

TINY = preset("tiny").config
PLANE = np.array([0.0, -1.0, 0.0, 1.6])


def a_frame(seed: int = 0) -> Frame:
    """Two boxes of points on flat ground, a picture with a bright patch where each one is."""
    rng = np.random.default_rng(seed)
    boxes = np.array([[-2.4, 1.6, 9.4, 4.2, 1.7, 1.5, 0.1], [3.4, 1.6, 14.6, 4.2, 1.7, 1.5, 1.5]])
    p2 = np.array([[70.0, 0, 48, 0], [0, 70.0, 16, 0], [0, 0, 1, 0]])
    velo = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    calibration = Calibration(np.stack([p2] * 4), np.eye(3), velo, velo)
    clouds = [np.stack([rng.uniform(-7, 7, 300), np.full(300, 1.6), rng.uniform(4, 20, 300)], 1)]
    for x, y, z, length, width, height, yaw in boxes:
        local = rng.uniform(-0.5, 0.5, (150, 3)) * [length, height, width]
        c, s = np.cos(yaw), np.sin(yaw)
        px, pz = c * local[:, 0] + s * local[:, 2], -s * local[:, 0] + c * local[:, 2]
        clouds.append(np.stack([x + px, y - height / 2 + local[:, 1], z + pz], axis=1))
    camera = np.concatenate(clouds)
    lidar = np.stack([camera[:, 2], -camera[:, 0], -camera[:, 1]], axis=1)
    points = np.concatenate([lidar, np.full((len(lidar), 1), 0.5)], axis=1).astype(np.float32)
    image = np.full((32, 96, 3), 80, np.uint8)
    image[10:20, 30:50] = 200
    n = len(boxes)
    labels = Objects(
        np.array(["Car"] * n, "<U14"), np.zeros(n), np.zeros(n, np.int64), np.zeros(n),
        np.array([[20.0, 5, 45, 28], [55, 8, 75, 25]]), boxes[:, [5, 4, 3]], boxes[:, :3],
        boxes[:, 6], np.full(n, np.nan),
    )  # fmt: skip
    return Frame("000000", image, points, calibration, labels, PLANE)


@pytest.fixture(scope="module")
def example() -> Example:
    made, counts = make_example(TINY, a_frame())
    assert counts == {"plane_fitted": False, "points_dropped": 0, "labels_dropped": 0}
    return made


def test_examples_keep_what_is_in_the_picture(example: Example) -> None:
    frame = a_frame()
    assert example.image.shape == (16, 48, 3) and example.image.dtype == np.uint8
    kept = example.points[example.point_mask]
    # Lidar coordinates: forward is z of the camera, and u = 70 x / z + 48 lies in [0, 96).
    u = -70 * kept[:, 1] / kept[:, 0] + 48
    assert (u >= 0).all() and (u < 96).all()
    expected = -70 * frame.points[:, 1] / frame.points[:, 0] + 48
    v = -70 * frame.points[:, 2] / frame.points[:, 0] + 16
    seen = (expected >= 0) & (expected < 96) & (v >= 0) & (v < 32)
    assert len(kept) == seen.sum() < len(frame.points)
    np.testing.assert_allclose(example.truth[:2, 6], [0.1, 1.5], atol=1e-6)
    assert example.truth_mask.tolist() == [True, True, False, False]
    np.testing.assert_allclose(example.image_size, [32, 96])

    few = dataclasses.replace(TINY, max_points=50, max_objects=1)
    made, counts = make_example(few, frame)
    assert counts["points_dropped"] == seen.sum() - 50 and counts["labels_dropped"] == 1
    np.testing.assert_allclose(made.truth[0, 2], 9.4)  # the nearer one stays
    behind = frame._replace(points=frame.points * np.array([-1, 1, 1, 1], np.float32))
    with pytest.raises(ValueError, match="frame 000000: none of 600 lidar points lies in the im"):
        make_example(TINY, behind)
    with pytest.raises(ValueError, match=r"frame 000000: .* points near the expected ground"):
        make_example(TINY, frame._replace(plane=None, points=frame.points[:9]))
    # A camera at 0.7 m: a plane within the limits is found, and hardly a point lies on it.
    low = frame.points + np.array([0, 0, 0.9, 0], np.float32)
    with pytest.raises(ValueError, match=r"% of the points near the expected ground lie on one"):
        make_example(TINY, frame._replace(plane=None, points=low))
    mount = PlaneConfig(camera_height=0.7, height_tolerance=0.3)
    made, counts = make_example(TINY, frame._replace(plane=None, points=low), mount)
    np.testing.assert_allclose(made.plane, [0, -1, 0, 0.7], atol=0.05)
    with pytest.raises(ValueError, match=r"frame 000000: \d+ % of the points lie more than 0.7 m"):
        make_example(TINY, frame._replace(plane=np.array([0.0, -1.0, 0.0, 0.1])))


def test_mirrored_frames_keep_their_projection(example: Example) -> None:
    truth, p2 = jnp.asarray(example.truth[:2]), jnp.asarray(example.p2)
    points = jnp.asarray(a_frame().points[:5, :3])
    plane = jnp.array([0.1, -0.99, 0.05, 1.6])
    image = jnp.arange(36.0).reshape(3, 4, 3)
    turned, moved, new_p2, new_plane, boxes = flip(image, points, p2, jnp.float32(96), plane, truth)
    np.testing.assert_array_equal(turned, image[:, ::-1])
    before = np.asarray(project_boxes(box_corners(truth), p2, 32.0, 96.0))
    after = np.asarray(project_boxes(box_corners(boxes), new_p2, 32.0, 96.0))
    np.testing.assert_allclose(after[:, [0, 2]], before[:, [0, 2]], atol=1e-4)
    np.testing.assert_allclose(after[:, [1, 3]], 1 - before[:, [3, 1]], atol=1e-4)
    np.testing.assert_allclose(moved @ new_plane[:3], points @ plane[:3], rtol=1e-5)


@pytest.mark.parametrize(
    ("height", "width", "c", "f"), [(4, 6, 3, 8), (5, 6, 2, 4), (4, 6, 4, 16), (3, 5, 4, 4)]
)
def test_convolution_in_blocks_equals_the_plain_one(
    height: int, width: int, c: int, f: int
) -> None:
    def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (2, height, width, c))
    kernel = jax.random.normal(keys[1], (3, 3, c, f))
    g = jax.random.normal(keys[2], (2, height, width, f))
    for ours, theirs in zip(
        *(
            jax.jit(lambda x, k, g, run=run: (run(x, k), *jax.vjp(run, x, k)[1](g)))(x, kernel, g)
            for run in (convolve, plain)
        ),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)


@pytest.mark.parametrize(("side", "padding"), [(3, 1), (2, 0)])
def test_low_precision_rounds_factors_and_keeps_sums(side: int, padding: int) -> None:
    def rounded(a: jax.Array) -> jax.Array:
        return a.astype(jnp.bfloat16).astype(jnp.float32)

    def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x, kernel, (1, 1), [(padding, padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )  # fmt: skip

    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (2, 5, 6, 4))
    kernel = jax.random.normal(keys[1], (side, side, 4, 5))
    wanted, their_vjp = jax.vjp(plain, rounded(x), rounded(kernel))
    got, our_vjp = jax.vjp(partial(low_convolve, padding=padding), x, kernel)
    g = jax.random.normal(keys[2], got.shape)
    # Sums in bfloat16 would be off by 2 % here, those of the weights' gradient by more.
    for a, b in zip((got, *our_vjp(g)), (wanted, *their_vjp(rounded(g))), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_group_norm_equals_the_library_and_its_gradient() -> None:
    layer: Any = nn.GroupNorm(num_groups=None, group_size=GROUP_SIZE, epsilon=1e-3)

    def theirs(x: jax.Array, scale: jax.Array, bias: jax.Array) -> jax.Array:
        return nn.relu(layer.apply({"params": {"scale": scale, "bias": bias}}, x))

    keys = jax.random.split(jax.random.key(0), 4)
    x = 0.5 + 2.0 * jax.random.normal(keys[0], (2, 5, 6, 8))
    scale, bias = 1.0 + 0.3 * jax.random.normal(keys[1], (8,)), jax.random.normal(keys[2], (8,))
    g = jax.random.normal(keys[3], x.shape)
    (ours, our_vjp), (expected, their_vjp) = (
        jax.vjp(run, x, scale, bias) for run in (group_norm_relu, theirs)
    )
    np.testing.assert_allclose(ours, expected, atol=1e-5)
    for got, wanted in zip(our_vjp(g), their_vjp(g), strict=True):
        np.testing.assert_allclose(got, wanted, atol=3e-5)


def test_transposed_convolution_equals_the_dilated_one() -> None:
    x = jax.random.normal(jax.random.key(0), (2, 3, 5, 4))
    ours: Any = TransposedConv(6)
    params = ours.init(jax.random.key(1), x)
    # Dilated by 2 and padded by (1, 2): output 2i + a reads input (2i + a - 1 + m) / 2, where our
    # kernel counts its taps the other way round.
    kernel = params["params"]["kernel"][::-1, ::-1]
    expected = jax.lax.conv_general_dilated(
        x, kernel, (1, 1), ((1, 2), (1, 2)), lhs_dilation=(2, 2),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )  # fmt: skip
    got = ours.apply(params, x)
    assert got.shape == (2, 6, 10, 6)
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_parameters_match_and_weights_start_even() -> None:
    for name in ("paper", "small"):
        avod, argate = (
            count_main_parameters(preset(name, m).config) for m in ("avod", "avod_argate")
        )
        assert avod < argate < 1.02 * avod
    batch_norm = dataclasses.replace(TINY, norm="batch")
    params, stats = jax.jit(partial(init_detector, config=batch_norm))(jax.random.key(0))
    assert set(params) == {"main", "auxiliary", "targets", "mean_losses"}
    assert jax.tree.leaves(stats)
    assert float(jnp.abs(params["main"]["gate"]["fusion"]["kernel"]).max()) == 0
    kernel = params["main"]["second"]["fc0"]["kernel"]
    np.testing.assert_allclose(kernel.std(), np.sqrt(2 / kernel.shape[0]), rtol=0.1)
    crops = (jnp.full((1, 2, 3, 3, 1), 2.0), jnp.full((1, 2, 3, 3, 1), 4.0))
    np.testing.assert_allclose(fuse(crops, jnp.ones((1, 2))), 3.0)
    np.testing.assert_allclose(fuse(crops, jnp.array([[2.0, 0.0]])), 2.0)


def test_rotated_suppression_keeps_cars_that_stand_side_by_side_at_an_angle() -> None:
    # Two cars parked at 45 degrees, 2.4 m apart across their length: free of each other, while the
    # upright rectangles around them share a fifth of theirs.
    across = 2.4 / np.sqrt(2)
    boxes = np.array([[0, 1.6, 10, 4.2, 1.7, 1.5, np.pi / 4]] * 2, np.float32)
    boxes[1, [0, 2]] += [across, across]
    scores = jnp.array([[0.0, 2.0], [0.0, 1.0]])
    half, kept = jnp.full(2, 0.5), {}
    for overlap in ("upright", "rotated"):
        config = dataclasses.replace(TINY, final_overlap=overlap)
        kept[overlap] = int(
            final_boxes(
                config, jnp.asarray(boxes), scores, jnp.ones(2, bool), half, half
            ).mask.sum()
        )
    assert kept == {"upright": 1, "rotated": 2}
    with pytest.raises((ValueError, TypeError), match="final_overlap"):
        dataclasses.replace(TINY, final_overlap="round")  # type: ignore[arg-type]


def test_mini_batches_are_half_positive_at_most() -> None:
    boxes = jnp.array(
        [[0.0, 0, 2, 2], [0.4, 0, 2.4, 2], [1, 0, 3, 2], [9, 9, 11, 11], [0, 0, 2, 2]]
    )
    truth = jnp.array([[0.0, 0, 2, 2], [0, 0, 2, 2]])
    got = assign(
        boxes, jnp.array([True] * 4 + [False]), truth, jnp.array([True, False]), (0.3, 0.5)
    )
    # Overlaps 1, 2/3, 1/3 (neither), 0; the last box is padding.
    assert got.positive.tolist() == [True, True, False, False, False]
    assert got.negative.tolist() == [False, False, False, True, False]
    n = 40
    positive = jnp.arange(n) < 30
    many = Assignment(positive, jnp.arange(n) >= 32, jnp.zeros(n, jnp.int32))
    chosen = set()
    for seed in range(20):
        sample = draw(many, 16, key=jax.random.key(seed))
        index = np.asarray(sample.indices)
        assert sample.valid.all() and len(set(index.tolist())) == 16
        assert (index[np.asarray(sample.positive)] < 30).all() and sample.positive.sum() == 8
        assert (index[~np.asarray(sample.positive)] >= 32).all()
        chosen |= set(index.tolist())
    assert len(chosen) > 30  # drawn, not always the same
    few = Assignment(jnp.arange(n) < 2, jnp.arange(n) >= 35, many.match)
    sample = draw(few, 16, key=jax.random.key(0))
    assert sample.positive.sum() == 2 and sample.valid.sum() == 7


def test_losses_by_hand() -> None:
    sample = Sample(
        jnp.arange(4), jnp.array([True, False, False, True]), jnp.array([True, True, False, True])
    )
    scores = jnp.log(jnp.array([[0.25, 0.75], [0.5, 0.5], [1e-6, 1.0], [0.9, 0.1]]))
    expected = -(np.log(0.75) + np.log(0.5) + np.log(0.1)) / 3
    np.testing.assert_allclose(class_loss(scores, sample), expected, rtol=1e-5)
    balanced = -0.25 * (np.log(0.75) + np.log(0.1)) - 0.5 * np.log(0.5)
    np.testing.assert_allclose(balanced_class_loss(scores, sample), balanced, rtol=1e-5)
    predicted = jnp.array([[0.5, 2.0], [9.0, 9.0], [9.0, 9.0], [0.0, 0.0]])
    got = regression_loss(predicted, jnp.zeros((4, 2)), sample)
    np.testing.assert_allclose(got, (0.125 + 1.5) / 2)
    nothing = Sample(jnp.arange(4), jnp.zeros(4, bool), jnp.ones(4, bool))
    assert float(regression_loss(predicted, jnp.zeros((4, 2)), nothing)) == 0


def test_gate_is_regularized_by_what_the_views_tell_apart() -> None:
    sample = Sample(
        jnp.arange(4)[None], jnp.array([[True, False, False, False]]), jnp.ones((1, 4), bool)
    )
    knows = jnp.array([[[-3.0, 3], [3, -3], [3, -3], [3, -3]]])
    views = [(jnp.zeros((1, 4, 2)), jnp.zeros((1, 4, 6))), (knows, jnp.ones((1, 4, 6)))]
    config = dataclasses.replace(
        TINY, gate_loss=dataclasses.replace(TINY.gate_loss, learned_targets=False)
    )
    gate, even, wanted = DetectorParams().gate, jnp.full((1, 2), 0.5), (jnp.zeros((1, 4, 6)),)
    stage = path_losses(config, views, wanted, sample)
    told = np.log1p(np.exp(-6.0))
    np.testing.assert_allclose(stage.balanced, [[np.log(2), told]], rtol=1e-4)
    # Boxes: half the square of 1 in six columns, times their weight.
    boxes = 3.0 * config.regression_weight
    np.testing.assert_allclose(stage.whole, [[np.log(2), told + boxes]], rtol=1e-4)
    # Its boxes are worse, and yet the second view's weight should rise: it tells objects from the
    # background better than it meanly does, by more than the first one.
    mean = jnp.array([0.6, 0.1])
    params = {"mean_losses": mean}
    target = jax.nn.softmax(-(stage.balanced - mean[None]) / gate.tau)
    assert target[0, 1] > 0.5
    total, auxiliary, regularization = gate_terms(config, gate, params, even, [stage, stage])
    off = 0.5 * ((stage.balanced - mean[None]) ** 2).sum()
    parts = gate.alpha * auxiliary + gate.beta * regularization
    np.testing.assert_allclose(total, parts + off, rtol=1e-4)
    np.testing.assert_allclose(auxiliary, stage.whole.sum(), rtol=1e-4)  # half of each, twice
    np.testing.assert_allclose(regularization, ((0.5 - target) ** 2).sum(), rtol=1e-4)
    # A frame without objects says nothing about its sensors.
    empty = path_losses(config, views, wanted, sample._replace(positive=jnp.zeros((1, 4), bool)))
    assert float(gate_terms(config, gate, params, even, [empty])[2]) == 0.0
    slope = jax.grad(lambda p: gate_terms(config, gate, p, even, [stage])[0])(params)
    np.testing.assert_allclose(slope["mean_losses"], mean - stage.balanced[0], rtol=1e-3)


def test_right_offsets_decode_to_the_label() -> None:
    plane = jnp.asarray(PLANE, jnp.float32)
    truth = jnp.array([[1.0, 1.5, 12.0, 4.0, 1.7, 1.5, 0.3], [-3, 1.6, 20, 3.6, 1.6, 1.5, -1.9]])
    proposals = jnp.array([[1.2, 1.6, 12.3, 4.2, 1.5, 1.6], [-3.1, 1.6, 19.5, 1.6, 1.5, 4.2]])
    offsets = box3d_to_box4c(truth, plane) - box3d_to_box4c(anchor_boxes(proposals), plane)
    angle = jnp.stack([jnp.cos(truth[:, 6]), jnp.sin(truth[:, 6])], axis=1)
    boxes = decode_second(proposals, offsets, angle, plane)
    np.testing.assert_allclose(boxes, truth, atol=1e-4)
    config = dataclasses.replace(TINY, score_threshold=0.2, max_detections=3)
    twice = jnp.concatenate([boxes, boxes + 0.05, boxes.at[:, 0].add(30.0)])
    scores = jnp.array([[0.0, 2], [0, 3], [0, 1], [0, 0.5], [0, -3], [0, 4]])
    mask = jnp.array([True, True, True, True, True, False])
    found = final_boxes(config, twice, scores, mask, jnp.array([0.4, 0.6]), jnp.zeros(2))
    # Doubles go, the fifth is below the threshold, the sixth is no proposal.
    assert found.mask.tolist() == [True, True, False]
    np.testing.assert_allclose(found.boxes[:2], truth[::-1], atol=1e-4)
    np.testing.assert_allclose(found.scores[0], 1 / (1 + np.exp(-3)), rtol=1e-5)


def test_detections_become_kitti_objects() -> None:
    frame = a_frame()
    truth = np.asarray(make_example(TINY, frame)[0].truth[:3], np.float32)
    truth[2] = [0, 1.6, -9, 4, 1.6, 1.5, 0]  # behind the camera
    found = Detections(
        jnp.asarray(truth), jnp.array([0.9, 0.8, 0.7]), jnp.ones(3, bool), jnp.full(2, 0.5),
        jnp.full(2, 0.1),
    )  # fmt: skip
    objects = to_objects(found, frame.calibration.p2, np.array([32.0, 96.0]))
    assert len(objects) == 2 and frame.labels is not None
    np.testing.assert_allclose(objects.dimensions, frame.labels.dimensions, atol=1e-5)
    np.testing.assert_allclose(objects.location, frame.labels.location, atol=1e-5)
    assert (objects.bbox[:, :2] >= 0).all() and (objects.bbox[:, 2] <= 95).all()
    np.testing.assert_allclose(objects.alpha[1], 1.5 - np.arctan2(3.4, 14.6), atol=1e-5)
    # In pixels of the benchmark the labels are 23 * 12.9 and 17 * 12.9 high: all count.
    assert image_scale(1242.0) == 1.0 and image_scale(96.0) == 1242 / 96
    exact = dataclasses.replace(objects, bbox=frame.labels.bbox, alpha=frame.labels.alpha)
    scored = class_precision([frame.labels], [exact], [96.0])
    assert scored.n_objects.tolist() == [[2, 2, 2]] and scored.precision[0, 3, 1, 1] == 1.0
    assert weight_auroc(np.array([[0.5, 0.5]] * 4), np.array([[0.2, 0.8]] * 4), 0) == 1.0


FAILING = DetectorTrainConfig(
    steps=6, batch_size=1, schedule="cosine", failure_share=0.9,
    failure_kinds=("camera_noise", "lidar_loss"),
)  # fmt: skip
RATES = DetectorParams(learning_rate=3e-3, l2=0.0, l2_dense=0.0)


@pytest.mark.slow
@pytest.mark.relaxed
def test_training_steps_resumes_and_detects(example: Example, tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    rows: list[int] = []
    whole = fit_detector(
        TINY, FAILING, RATES, 3, lambda i: example, seed=3, report_every=2,
        on_report=lambda step, row: rows.append(step),
    )  # fmt: skip
    assert rows == [2, 4, 6] and int(whole.state.step) == 6
    other = RATES._replace(learning_rate=1e-4, l2=1e-3, clip_norm=1.0)
    slow = fit_detector(TINY, FAILING, other, 3, lambda i: example, seed=3, report_every=2)
    assert slow.history[0]["total"] != slow.history[-1]["total"] != whole.history[-1]["total"]
    # Other rates ran the same program.
    assert fitting._step(TINY, FAILING, None)._cache_size() == 1  # type: ignore[attr-defined]
    assert all(np.isfinite(list(row.values())).all() for row in whole.history)
    assert whole.history[0]["rpn_positives"] > 0 and whole.history[0]["positives"] > 0
    assert 0 < whole.history[-1]["weight_camera"] < 1
    assert float(check_targets(TINY.targets, whole.state.params["targets"])) == 0.0

    def stop(step: int, row: dict[str, float]) -> None:
        if step == 4:
            signal.raise_signal(signal.SIGINT)  # held back until the step after it is done

    with pytest.raises(KeyboardInterrupt):
        fit_detector(TINY, FAILING, RATES, 3, lambda i: example, seed=3, report_every=2,
                     on_report=stop, checkpoint_dir=folder)  # fmt: skip
    kept = restore_detector(TINY, folder)
    assert kept is not None and int(kept.step) == 5
    with pytest.raises(ValueError, match="holds checkpoints of another run"):
        fit_detector(TINY, FAILING, RATES, 3, lambda i: example, checkpoint_dir=folder)
    again = fit_detector(
        TINY,
        FAILING,
        RATES,
        3,
        lambda i: example,
        seed=3,
        report_every=2,
        checkpoint_dir=folder,
        resume=True,
    )
    for a, b in zip(jax.tree.leaves(whole.state), jax.tree.leaves(again.state), strict=True):
        np.testing.assert_array_equal(a, b)

    found = run_detector(TINY, whole.state, [example, example])
    assert len(found) == 2 and found[0].boxes.shape == (4, 7)
    np.testing.assert_array_equal(found[0].boxes, found[1].boxes)
    assert found[0].mask.any() and np.isfinite(found[0].boxes).all()
    np.testing.assert_allclose(found[0].weights.sum(), 1.0, rtol=1e-5)
    assert ((found[0].failed > 0) & (found[0].failed < 1)).all()
    # The head begins as the distance from clean readings, which tells more than a coin does.
    assert 0.0 < whole.history[0]["failure"] < np.log(2)
    # A dead lidar leaves the camera's proposals.
    dead = run_detector(TINY, whole.state, [example], failure="lidar_loss")
    assert dead[0].mask.any()
    with pytest.raises(ValueError, match="failure='lidar_theft': expected one of camera_noise"):
        run_detector(TINY, whole.state, [example], failure="lidar_theft")


def test_every_frame_comes_once_in_an_epoch() -> None:
    order = np.concatenate([frame_order(1, 5, step, 2) for step in range(5)])
    assert sorted(order[:5].tolist()) == sorted(order[5:].tolist()) == list(range(5))
    assert order[:5].tolist() != order[5:].tolist()
    assert frame_order(1, 5, 3, 2).tolist() == order[6:8].tolist()


def test_choices_are_checked_and_rates_fall() -> None:
    _, paper, rates = preset("paper")
    np.testing.assert_allclose(learning_rate(paper, rates, jnp.int32(59_999)), 0.8e-4, rtol=1e-5)
    np.testing.assert_allclose(learning_rate(paper, rates, jnp.int32(60_000)), 0.64e-4, rtol=1e-5)
    for make, message in (
        (lambda: DetectorTrainConfig(failure_share=1.5), "failure_share=1.5"),
        (lambda: DetectorTrainConfig(steps=0), "steps=0"),
        (
            lambda: DetectorTrainConfig(failure_kinds=("sun",)),
            "failure_kinds='sun': expected of camera_no",
        ),
        (lambda: DetectorTrainConfig(failure_share=0.5, failure_kinds=("camera_fog",)), "of each"),
        (lambda: preset("huge"), "size='huge': expected one of paper"),
        (lambda: preset("small", "yolo"), "model='yolo'"),
        (lambda: DetectorConfig(widths=(6, 8), layers=(1, 1), norm="group"), "multiples of 4"),
        (lambda: DetectorConfig(layers=(1,)), "one positive number of layers"),
        (lambda: DetectorConfig(rpn_iou=(0.6, 0.5)), "rpn_iou=.0.6, 0.5."),
        (lambda: DetectorConfig(dropout=1.0), "dropout=1.0"),
        (lambda: DetectorParams(learning_rate=-1.0), "learning_rate=-1.0: expected a finite"),
        (lambda: DetectorParams()._replace(clip_norm=0.0), "clip_norm=0.0: expected"),
        (lambda: DetectorParams(l2=float("nan")), "l2=nan: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    # Here beartype is first to refuse them, elsewhere the dataclass is.
    for make, message in (
        (lambda: DetectorConfig(normalizer="sparsemax"), "normalizer"),  # type: ignore[arg-type]
        (lambda: DetectorTrainConfig(schedule="step"), "schedule"),  # type: ignore[arg-type]
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            make()
    assert len(SENSOR_FAILURES) == 9


@pytest.mark.slow
@pytest.mark.relaxed
def test_avod_learns_two_cars(example: Example) -> None:
    config = preset("tiny", "avod").config
    train = dataclasses.replace(FAILING, steps=300, failure_share=0.0, flip=False)
    rates = RATES._replace(learning_rate=1e-2)
    fitted = fit_detector(config, train, rates, 1, lambda i: example)
    assert fitted.history[-1]["total"] < 0.2 * fitted.history[0]["total"]
    found = run_detector(config, fitted.state, [example])[0]
    best = found.boxes[:2][np.argsort(found.boxes[:2, 2])]
    np.testing.assert_allclose(best[:, [0, 2]], example.truth[:2, [0, 2]], atol=0.5)


def test_inputs_of_a_batch(example: Example) -> None:
    batch = stack_examples([example, example])
    inputs = jax.jit(jax.vmap(partial(make_inputs, TINY)))(batch)
    assert inputs.bev.shape == (2, 32, 32, 6) and inputs.anchors.shape == (2, 128, 6)
    assert int(inputs.n_occupied[0]) > 10 and inputs.bev[0].max() > 0.5
