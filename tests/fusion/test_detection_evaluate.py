"""Average precision: rules by hand, a plain-loop oracle, the official program's numbers."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fusion.detection.kitti import average_precision as module
from fusion.detection.kitti.average_precision import (
    average_precision_cap,
    evaluate,
    hardness_by_distance,
    hardness_by_points,
    recall_thresholds,
)
from fusion.detection.kitti.objects import Objects, concatenate, empty, select

ROOT = Path(__file__).resolve().parent.parent
RECORD = json.loads((ROOT / "golden" / "kitti_ap.json").read_text(encoding="utf-8"))
CURVES = ("detection", "orientation", "detection_BEV", "detection_3D")  # in the order of METRICS


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


make = load(ROOT / "golden" / "kitti_make.py")
SETS = {name: rest for name, *rest in make.SETS}
GENERATED = [name for name, rest in SETS.items() if rest[0]]
REAL = [name for name, rest in SETS.items() if not rest[0]]


def compare(name: str, labels: list[Objects]) -> None:
    """AP of the set equals the official program's to 1e-4, for every curve that it printed."""
    record = RECORD[name]
    detections = make.make_detections(labels, SETS[name][2], SETS[name][3])
    found = concatenate(detections)
    assert (record["n_frames"], record["n_detections"]) == (len(labels), len(found)), (
        "the generator no longer makes the recorded set"
    )
    result = evaluate(labels, detections)
    for points in (11, 40):
        ap = result.average_precision(points)
        for c, kind in enumerate(result.classes):
            for m, curve in enumerate(CURVES):
                expected = record["ap"].get(kind, {}).get(curve)
                if expected is None:
                    # Not evaluated officially: we report that nothing was found, or NaN.
                    assert (np.nan_to_num(ap[c, m]) == 0).all()
                    continue
                # Where no object counts the official program says 0, we say NaN.
                ours = np.where(result.n_objects[c] == 0, 0.0, ap[c, m])
                np.testing.assert_allclose(
                    ours, expected[f"r{points}"], atol=1e-4, rtol=0, err_msg=f"{kind} {curve}"
                )


@pytest.mark.parametrize("name", GENERATED)
def test_equals_the_official_program(name: str) -> None:
    n_frames, seed = SETS[name][:2]
    compare(name, make.make_labels(seed, n_frames))


@pytest.fixture(scope="module")
def label_folder(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All label files of the benchmark, unpacked once."""
    import tarfile

    folder = tmp_path_factory.mktemp("labels")
    with tarfile.open(data_dir / "kitti" / "label_2_training_7481.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder / "training" / "label_2"


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_equals_the_official_program_on_real_labels(name: str, label_folder: Path) -> None:
    compare(name, make.real_labels(label_folder, SETS[name][1])[1])


def car(**changes: object) -> Objects:
    """One easy car, with changes to its fields."""
    base: dict[str, object] = {
        "type": "Car", "truncated": 0.0, "occluded": 0, "alpha": 0.5,
        "bbox": [100.0, 100.0, 200.0, 200.0], "dimensions": [1.5, 1.6, 4.0],
        "location": [0.0, 1.7, 15.0], "rotation_y": 0.3, "score": 0.9,
    }  # fmt: skip
    return Objects(**{k: np.array([v]) for k, v in {**base, **changes}.items()})  # type: ignore[arg-type]


def hits(truth: list[Objects], found: list[Objects]) -> tuple[int, np.ndarray]:
    """Cars that count as easy and 2D precision at the first recall step, one frame."""
    result = evaluate([concatenate(truth)], [concatenate(found)], classes=("Car",))
    return int(result.n_objects[0, 0]), result.precision[0, :, 0, 0]


def test_rules_by_hand() -> None:
    far = {"bbox": [500.0, 100.0, 600.0, 200.0], "location": [9.0, 1.7, 30.0]}
    n, first = hits([car()], [car()])
    assert n == 1
    np.testing.assert_allclose(first, 1.0)
    # A second detection of the same car and score is a false alarm, in all metrics; one with a
    # lower score lies below the only threshold.
    np.testing.assert_allclose(hits([car()], [car(), car()])[1], 0.5)
    # A van takes its detection without counting; a truck does not.
    np.testing.assert_allclose(hits([car(), car(type="Van", **far)], [car(), car(**far)])[1], 1.0)
    np.testing.assert_allclose(hits([car(), car(type="Truck", **far)], [car(), car(**far)])[1], 0.5)
    # So does a car too hard, too cut or too small for the difficulty (40 pixels are too small).
    small = {**far, "bbox": [500.0, 100.0, 600.0, 140.0]}
    for change in ({"occluded": 1}, {"truncated": 0.16}, small):
        place = {**far, **change}
        n, first = hits([car(), car(**place)], [car(), car(**place, score=1.0)])
        assert n == 1
        np.testing.assert_allclose(first[:1], 1.0)
    # DontCare excuses a detection that it covers by more than the limit, in the image only.
    care = car(type="DontCare", occluded=-1, truncated=-1, bbox=[490.0, 90, 600, 175],
               dimensions=[-1, -1, -1], location=[-1000, -1000, -1000])  # fmt: skip
    np.testing.assert_allclose(hits([car(), care], [car(), car(**far)])[1], [1, 1, 0.5, 0.5])
    care = dataclasses.replace(care, bbox=care.bbox - [0, 0, 0, 10.0])
    np.testing.assert_allclose(hits([car(), care], [car(), car(**far)])[1], 0.5)
    # Detections below 40 pixels neither hit nor disturb.
    tiny = car(**{**small, "bbox": [500.0, 100.0, 600.0, 139.9], "score": 1.0})
    np.testing.assert_allclose(hits([car()], [car(), tiny])[1], 1.0)
    np.testing.assert_allclose(hits([car()], [car(), car(**{**small, "score": 1.0})])[1], 0.5)
    # Orientation: half a circle off scores nothing, a quarter a half.
    for turn, expected in ((np.pi, 0.0), (np.pi / 2, 0.5)):
        np.testing.assert_allclose(
            hits([car()], [car(alpha=0.5 + turn)])[1][1], expected, atol=1e-9
        )
    assert np.isnan(hits([car()], [car(alpha=-10.0)])[1][1])


def test_a_region_without_3d_box_excuses_detections_without_one() -> None:
    """The official program compares the -1 x -1 squares at (-1000, -1000), and they coincide."""
    flat = {"dimensions": [-1.0, -1.0, -1.0], "location": [-1000.0] * 3, "rotation_y": -10.0}
    away = {"bbox": [500.0, 100.0, 600.0, 200.0]}
    care = car(type="DontCare", occluded=-1, truncated=-1, bbox=[10.0, 10, 20, 20], **flat)
    lost = car(**away, **flat)  # a false alarm that is drawn in the image alone
    np.testing.assert_allclose(hits([car()], [car(), lost])[1], 0.5)
    np.testing.assert_allclose(hits([car(), care], [car(), lost])[1], [0.5, 0.5, 1.0, 0.5])
    # A region in another frame excuses nothing.
    two = evaluate([car(), care], [concatenate([car(), lost]), empty()], classes=("Car",))
    np.testing.assert_allclose(two.precision[0, 2, 0, 0], 0.5)


def test_range_bins_count_objects_and_false_alarms_of_a_bin() -> None:
    def at(z: float, **changes: object) -> Objects:
        return car(location=[0.0, 1.7, z], **changes)

    # An object at the border belongs to the farther bin.
    labels, found = [at(10.0), at(20.0), at(60.0)], [at(10.0), at(20.0), at(60.0), at(35.0)]
    place = {"bbox": [500.0, 100.0, 600.0, 200.0]}
    found[3] = at(35.0, **place)
    frames = [concatenate(labels)], [concatenate(found)]
    counts, first = [], []
    for bounds in ((0.0, 20.0), (20.0, 40.0), (40.0, float("inf"))):
        result = evaluate(*frames, classes=("Car",), distance=bounds)
        counts.append(int(result.n_objects[0, 1]))
        first.append(float(result.precision[0, 3, 1, 0]))
    assert counts == [1, 1, 1]
    np.testing.assert_allclose(first, [1.0, 0.5, 1.0])  # the false alarm lies at 35 m
    whole = evaluate(*frames, classes=("Car",))
    assert int(whole.n_objects[0, 1]) == 3
    with pytest.raises(ValueError, match=r"distance=\(20\.0, 20\.0\): expected the lower"):
        evaluate(*frames, distance=(20.0, 20.0))


def test_data_without_2d_boxes_says_why_and_has_other_difficulties() -> None:
    none = {"bbox": [0.0, 0.0, 0.0, 0.0]}
    labels = concatenate([car(location=[0.0, 1.7, z], **none) for z in (10.0, 30.0, 50.0)])
    with pytest.raises(ValueError, match="none of 3 labels has a 2D box, by whose height"):
        evaluate([labels], [labels], classes=("Car",))
    boxed = dataclasses.replace(labels, bbox=labels.bbox + np.array([0, 0, 60, 60]))
    with pytest.raises(ValueError, match="none of 3 detections has a 2D box"):
        evaluate([boxed], [labels], classes=("Car",))
    levels = hardness_by_distance([labels])
    assert levels[0].tolist() == [0, 1, 2]
    result = evaluate([labels], [labels], classes=("Car",), hardness=levels)
    assert result.n_objects.tolist() == [[1, 2, 3]]
    np.testing.assert_allclose(result.precision[0, 3, :, 0], 1.0)
    assert hardness_by_points([np.array([150, 20, 5, 4])])[0].tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="hardness: expected one number for every label"):
        evaluate([labels], [labels], hardness=[np.zeros(2)])


def test_best_overlap_wins_and_pass_one_takes_the_best_score() -> None:
    # The detection with the better score overlaps less: pass one keeps its score as the only
    # threshold, so only it is left in pass two.
    shifted = car(bbox=[110.0, 100, 210, 200], score=0.95)
    np.testing.assert_allclose(hits([car()], [car(), shifted])[1][0], 1.0)
    shifted = dataclasses.replace(shifted, score=np.array([0.5]))
    np.testing.assert_allclose(hits([car()], [car(), shifted])[1][0], 1.0)


def plain_curve(labels: list[Objects], detections: list[Objects], limit: float) -> np.ndarray:
    """2D precision of easy cars, one object and one threshold at a time."""

    def overlap(a: np.ndarray, b: np.ndarray, own: bool = False) -> float:
        w = min(a[2], b[2]) - max(a[0], b[0])
        h = min(a[3], b[3]) - max(a[1], b[1])
        if w <= 0 or h <= 0:
            return 0.0
        area = (a[2] - a[0]) * (a[3] - a[1])
        return w * h / (area if own else area + (b[2] - b[0]) * (b[3] - b[1]) - w * h)

    def count(frame: int, threshold: float | None) -> tuple[int, int, list[float]]:
        truth, found = labels[frame], detections[frame]
        small = [b[3] - b[1] < 40 for b in found.bbox]
        live = [
            (small[j] or found.type[j] == "Car")
            and (threshold is None or found.score[j] >= threshold)
            for j in range(len(found))
        ]
        hit, scores = 0, []
        for i in range(len(truth)):
            if truth.type[i] not in ("Car", "Van"):
                continue
            height = truth.bbox[i, 3] - truth.bbox[i, 1]
            hard = truth.occluded[i] > 0 or truth.truncated[i] > 0.15 or height <= 40
            skip = hard or truth.type[i] == "Van"
            able = [
                j for j in range(len(found))
                if live[j] and overlap(found.bbox[j], truth.bbox[i]) > limit
            ]  # fmt: skip
            if not able:
                continue
            if threshold is None:
                best = max(able, key=lambda j: (found.score[j], -j))
            else:
                big = [j for j in able if not small[j]]
                value = {j: overlap(found.bbox[j], truth.bbox[i]) for j in big}
                best = max(big, key=lambda j: (value[j], -j)) if big else able[0]
            live[best] = False
            if not skip and not small[best]:
                hit += 1
                scores.append(float(found.score[best]))
        regions = truth.bbox[truth.type == "DontCare"]
        false = sum(
            live[j] and not small[j]
            and not any(overlap(found.bbox[j], r, True) > limit for r in regions)
            for j in range(len(found))
        )  # fmt: skip
        return hit, false, scores

    scores = [s for f in range(len(labels)) for s in count(f, None)[2]]
    n = sum(
        int(((f.type == "Car") & (f.occluded == 0) & (f.truncated <= 0.15)
             & (f.bbox[:, 3] - f.bbox[:, 1] > 40)).sum())
        for f in labels
    )  # fmt: skip
    curve = np.zeros(41)
    for t, threshold in enumerate(recall_thresholds(np.array(scores), n)):
        parts = [count(f, float(threshold))[:2] for f in range(len(labels))]
        hit, false = sum(p[0] for p in parts), sum(p[1] for p in parts)
        curve[t] = hit / (hit + false)
    return np.maximum.accumulate(curve[::-1])[::-1]


def test_equals_one_object_at_a_time() -> None:
    labels = make.make_labels(30, 80)
    detections = make.make_detections(labels, 31)
    limits = {"Car": 0.5}
    result = evaluate(labels, detections, classes=("Car",), min_overlap=limits)
    expected = plain_curve(labels, detections, 0.5)
    assert np.count_nonzero(expected) > 5 and 0.1 < expected[:5].mean() < 1
    np.testing.assert_allclose(result.precision[0, 0, 0], expected, atol=1e-12)


def test_perfect_detections_reach_the_cap_of_a_small_set() -> None:
    # 5, 22 and 100 cars at the three difficulties.
    kinds = [(0, 5), (1, 17), (2, 78)]
    labels = [
        car(occluded=level, location=[0.0, 1.7, 10.0 + i])
        for level, n in kinds for i in range(n)
    ]  # fmt: skip
    result = evaluate(labels, labels, classes=("Car",))
    assert result.n_objects.tolist() == [[5, 22, 100]]
    for points in (11, 40):
        caps = [average_precision_cap(n, points) for n in (5, 22, 100)]
        np.testing.assert_allclose(result.average_precision(points)[0], [caps] * 4)
    assert average_precision_cap(100, 11) == average_precision_cap(41, 40) == 100.0
    assert average_precision_cap(0, 40) == 0.0


def test_frames_and_order_of_frames_do_not_mix() -> None:
    labels = make.make_labels(32, 20)
    detections = make.make_detections(labels, 33)
    order = np.random.default_rng(0).permutation(20)
    a = evaluate(labels, detections).precision
    b = evaluate([labels[i] for i in order], [detections[i] for i in order]).precision
    np.testing.assert_allclose(a, b, atol=1e-12)
    # Detections moved to the wrong frame no longer hit.
    c = evaluate(labels, detections[1:] + detections[:1]).average_precision(40)
    assert np.nanmax(c) < 1.0


def test_nothing_found_is_zero_and_nothing_there_is_nan() -> None:
    labels = make.make_labels(34, 5)
    result = evaluate(labels, [empty()] * 5)
    ap = result.average_precision(40)
    counts = np.broadcast_to(result.n_objects[:, None] > 0, ap.shape)
    assert (ap[counts] == 0).all() and np.isnan(ap[~counts]).all()
    assert result.n_detections.tolist() == [0, 0, 0]
    none = evaluate([empty()], [car()], classes=("Car",))
    assert np.isnan(none.precision).all()


def test_bad_input_is_named() -> None:
    labels = make.make_labels(35, 2)
    with pytest.raises(ValueError, match="2 frames of labels and 1 of detections"):
        evaluate(labels, [empty()])
    with pytest.raises(ValueError, match="0 frames"):
        evaluate([], [])
    with pytest.raises(ValueError, match="frame 1: a detection has no finite score"):
        evaluate(labels, [empty(), select(labels[1], np.array([0]))])
    with pytest.raises(ValueError, match=r"min_overlap\['Tram'\] is None"):
        evaluate(labels, [empty()] * 2, classes=("Tram",))
    with pytest.raises(ValueError, match=r"min_height is \(40\.0, 25\.0\), expected three"):
        evaluate(labels, [empty()] * 2, min_height=(40.0, 25.0))
    with pytest.raises(ValueError, match="points=101, expected 11"):
        evaluate(labels, [empty()] * 2).average_precision(101)


def test_heights_scale_with_the_image() -> None:
    labels = make.make_labels(36, 30)
    detections = make.make_detections(labels, 37)

    def smaller(frames: list[Objects]) -> list[Objects]:
        return [dataclasses.replace(f, bbox=0.25 * f.bbox) for f in frames]

    whole = evaluate(labels, detections)
    quarter = evaluate(smaller(labels), smaller(detections), min_height=(10.0, 6.25, 6.25))
    np.testing.assert_allclose(quarter.precision, whole.precision, atol=1e-12)
    assert quarter.n_objects.tolist() == whole.n_objects.tolist()
    lost = evaluate(smaller(labels), smaller(detections))
    assert (lost.n_objects[0] < whole.n_objects[0]).all()


def test_thresholds_follow_recall() -> None:
    # 80 objects, all found: every second score is the closest to a step of 1/40.
    scores = np.arange(80, 0, -1.0)
    kept = recall_thresholds(scores[::-1], 80)
    assert len(kept) == 41 and kept[0] == 80 and kept[-1] == 1
    assert np.diff(kept).tolist() == [-1.0] + [-2.0] * 39
    assert module.N_POINTS == 41
