r"""Average precision as the KITTI object benchmark counts it: 2D, orientation, ground and 3D.

Precision is taken at up to 41 score thresholds, one for each step of 1/40 in recall, made monotone
from the right, and averaged over

.. math::
    AP_{R11} = \frac{1}{11} \sum_{i=0,4,\dots,40} p_i, \qquad
    AP_{R40} = \frac{1}{40} \sum_{i=1}^{40} p_i .

Orientation similarity replaces the count of true positives by
:math:`\sum (1 + \cos\Delta\alpha) / 2`.

`evaluate` also measures by distance (`distance`: objects and false alarms of a range bin), and for
data without 2D boxes by other difficulties than the image's (`hardness`).

Source: Geiger, Lenz, Urtasun (2012); the rules follow the benchmark's evaluation program, 2017
edition (41 thresholds), and R40 is that of Simonelli et al. (2019). Deviation: average precision is
NaN, not 0, where no object counts at a difficulty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion.detection.kitti.matching import (
    IGNORED,
    OTHER,
    VALID,
    Table,
    coverage,
    frame_pairs,
    match,
    overlaps,
    table_of,
)
from fusion.detection.kitti.objects import DONT_CARE, Objects, concatenate, select

METRICS = ("2d", "orientation", "bev", "3d")
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_OVERLAP: Mapping[str, float] = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
# A truth of the neighbouring class is neither a hit nor a miss.
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting"}
MIN_HEIGHT = (40.0, 25.0, 25.0)  # [pixel]
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.3, 0.5)
N_POINTS = 41


class Evaluation(NamedTuple):
    """Precision curves of every class, metric and difficulty.

    Attributes:
        classes: C class names.
        precision: `[C, 4, 3, 41]` over class, `METRICS`, `DIFFICULTIES` and recall step; the
            orientation is NaN where a detection had no angle.
        n_objects: `[C, 3]` objects that count at each difficulty.
        n_detections: `[C]` detections of the class.
    """

    classes: tuple[str, ...]
    precision: np.ndarray
    n_objects: np.ndarray
    n_detections: np.ndarray

    def average_precision(self, points: int) -> np.ndarray:
        """Average precision [%] `[C, 4, 3]`; `points` is 11 or 40, and the two never compare."""
        _check_points(points)
        steps = slice(0, None, 4) if points == 11 else slice(1, None)
        return 100.0 * self.precision[..., steps].mean(axis=-1)


def _check_points(points: int) -> None:
    if points not in (11, 40):
        raise ValueError(f"points={points}, expected 11 (until 2019) or 40 (since)")


def recall_thresholds(scores: np.ndarray, n_objects: int) -> np.ndarray:
    """The scores at which recall comes closest to 0, 1/40, ..., 1 (at most 41 of them).

    Args:
        scores: `[m]` scores of the matched detections, any order.
        n_objects: objects that count.

    Returns:
        Thresholds, descending.
    """
    ordered = np.sort(scores)[::-1]
    last = len(ordered) - 1
    kept: list[float] = []
    recall = 0.0
    # The running sum, not i / 40: the official program decides ties with its rounding.
    for i, score in enumerate(ordered.tolist()):
        left = (i + 1) / n_objects
        right = (i + 2) / n_objects if i < last else left
        if right - recall < recall - left and i < last:
            continue
        kept.append(score)
        recall += 1.0 / (N_POINTS - 1.0)
    return np.array(kept)


def average_precision_cap(n_objects: int, points: int) -> float:
    """The largest average precision [%] that a set with so few objects can reach.

    With n < 41 objects only about n recall steps exist, and the steps that are missing count as
    precision 0, `AP <= 100 (steps reached) / points`: perfect detections of 5 cars score 18.2
    under R11.

    Example:
        >>> round(average_precision_cap(5, 11), 1)
        18.2
    """
    _check_points(points)
    n = len(recall_thresholds(np.zeros(n_objects), n_objects)) if n_objects else 0
    reached = np.arange(N_POINTS) < n
    return float(100.0 * (reached[::4] if points == 11 else reached[1:]).mean())


def _from_right(curve: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(curve[::-1])[::-1]


def _curves(
    labels: Objects,
    detections: Objects,
    table: Table,
    truth_state: np.ndarray,
    detection_state: np.ndarray,
    covered: np.ndarray,
    n_objects: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Precision and orientation similarity `[41]`, monotone from the right."""
    precision, similarity = np.zeros(N_POINTS), np.zeros(N_POINTS)
    score = detections.score
    lowest = np.array([-np.inf])
    first = match(table, truth_state, detection_state, score, lowest, by_score=True)
    if not n_objects or not first.hits[0]:
        return precision, similarity
    matched = score[np.concatenate(first.matched_detection)]
    thresholds = recall_thresholds(matched, n_objects)
    counts = match(table, truth_state, detection_state, score, thresholds, by_score=False)
    # What is still open, counts and lies in no DontCare region is a false positive.
    false = (counts.left & (detection_state == VALID) & ~covered).sum(axis=1)
    truth, found = np.concatenate(counts.matched_truth), np.concatenate(counts.matched_detection)
    alike = (1.0 + np.cos(labels.alpha[truth] - detections.alpha[found])) / 2.0
    at = np.concatenate(counts.matched_threshold)
    alike_sum = np.bincount(at, weights=alike, minlength=len(thresholds))
    total = np.maximum(counts.hits + false, 1)
    precision[: len(thresholds)] = counts.hits / total
    similarity[: len(thresholds)] = alike_sum / total
    return _from_right(precision), _from_right(similarity)


def _truth_state(
    labels: Objects, name: str, difficulty: int, min_height: float, hardness: np.ndarray | None
) -> np.ndarray:
    if hardness is None:
        height = labels.bbox[:, 3] - labels.bbox[:, 1]
        hard = (
            (labels.occluded > MAX_OCCLUSION[difficulty])
            | (labels.truncated > MAX_TRUNCATION[difficulty])
            | (height <= min_height)
        )
    else:
        hard = hardness > difficulty
    state = np.where(labels.type == name, np.where(hard, IGNORED, VALID), OTHER)
    return np.where(labels.type == NEIGHBOUR.get(name, ""), IGNORED, state)


def _detection_state(detections: Objects, name: str, min_height: float) -> np.ndarray:
    # Small detections of every class are ignored, but may still take a truth.
    small = np.abs(detections.bbox[:, 1] - detections.bbox[:, 3]) < min_height
    return np.where(small, IGNORED, np.where(detections.type == name, VALID, OTHER))


def _within(objects: Objects, distance: tuple[float, float]) -> np.ndarray:
    """Which objects lie in a range bin; all of them in the whole range, without 3D box too."""
    if distance == (0.0, float("inf")):
        return np.ones(len(objects), bool)
    away = np.hypot(objects.location[:, 0], objects.location[:, 2])
    solid = (objects.dimensions > 0).all(axis=1)
    return solid & (away >= distance[0]) & (away < distance[1])


def _require_2d(
    labels: Sequence[Objects], detections: Sequence[Objects], classes: Sequence[str]
) -> None:
    """Refuse data that the image's difficulties would leave without a single object or hit."""
    for what, frames in (("label", labels), ("detection", detections)):
        boxes = [f.bbox[np.isin(f.type, classes)] for f in frames]
        high = np.concatenate([np.zeros(0), *(b[:, 3] - b[:, 1] for b in boxes)])
        if len(high) and not (high > 0).any():
            raise ValueError(
                f"none of {len(high)} {what}s has a 2D box, by whose height easy, moderate and "
                "hard are told apart: nothing would count; measure by distance or by points in "
                "the box (`hardness`, --difficulty distance or points)"
            )


def hardness_by_distance(
    labels: Sequence[Objects], limits: Sequence[float] = (20.0, 40.0, float("inf"))
) -> list[np.ndarray]:
    """Difficulty of each label by its distance on the ground, for `evaluate`.

    Args:
        labels: of every frame.
        limits: distance up to which an object is easy, moderate, hard [m]; our choice.
    """
    away = [np.hypot(f.location[:, 0], f.location[:, 2]) for f in labels]
    return [np.searchsorted(np.asarray(limits), a, side="right") for a in away]


def hardness_by_points(
    points: Sequence[np.ndarray], limits: Sequence[int] = (100, 20, 5)
) -> list[np.ndarray]:
    """Difficulty of each label by the lidar points in its box, for `evaluate`.

    Args:
        points: of every frame, their number for each label.
        limits: least number for easy, moderate, hard; our choice.
    """
    return [(np.asarray(p)[:, None] < np.asarray(limits)[None]).sum(axis=1) for p in points]


def evaluate(
    labels: Sequence[Objects],
    detections: Sequence[Objects],
    *,
    classes: Sequence[str] = ("Car", "Pedestrian", "Cyclist"),
    min_overlap: Mapping[str, float] = MIN_OVERLAP,
    min_height: Sequence[float] = MIN_HEIGHT,
    distance: tuple[float, float] = (0.0, float("inf")),
    hardness: Sequence[np.ndarray] | None = None,
) -> Evaluation:
    """Precision curves of detections against labels, frame by frame in the same order.

    Args:
        labels: the labels of each frame.
        detections: the detections of the same frames, with scores.
        classes: classes to evaluate.
        min_overlap: overlap above which (strictly) a detection hits, for each class.
        min_height: smallest 2D height at each difficulty [pixel]; for images of another size than
            the benchmark's, multiply by their scale.
        distance: from and up to which distance on the ground [m] objects count; other objects are
            ignored, and detections there are no false alarms. The benchmark has no such bound.
        hardness: of every frame's labels, the difficulty from which on each counts (0 easy, 1
            moderate, 2 hard, 3 never) in place of the image's rules; for data without 2D boxes,
            see `hardness_by_distance` and `hardness_by_points`.

    Returns:
        `Evaluation`; average precision by `.average_precision(11)` or `(40)`.

    Raises:
        ValueError: not the same number of frames, no frame, a detection without a finite score, a
            class without `min_overlap`, `min_height` not of three numbers, an empty `distance`,
            `hardness` of other sizes than the labels, or (without it) no label or no detection
            that has a 2D box.
    """
    if len(labels) != len(detections) or not labels:
        raise ValueError(
            f"{len(labels)} frames of labels and {len(detections)} of detections, expected the "
            "same number, at least one (a frame without detections is an empty `Objects`)"
        )
    if len(min_height) != len(DIFFICULTIES) or not min(min_height) >= 0.0:
        raise ValueError(f"min_height is {tuple(min_height)}, expected three heights >= 0 [pixel]")
    for name in classes:
        if not 0.0 < min_overlap.get(name, -1.0) < 1.0:
            raise ValueError(
                f"min_overlap[{name!r}] is {min_overlap.get(name)}, expected a number in (0, 1)"
            )
    if not 0.0 <= distance[0] < distance[1]:
        raise ValueError(f"distance={distance}: expected the lower bound [m] first, from 0 on")
    for i, frame in enumerate(detections):
        if not np.isfinite(frame.score).all():
            raise ValueError(f"frame {i}: a detection has no finite score")
    levels = None
    if hardness is None:
        _require_2d(labels, detections, classes)
    else:
        if [len(h) for h in hardness] != [len(f) for f in labels]:
            raise ValueError("hardness: expected one number for every label of every frame")
        levels = np.concatenate([np.zeros(0), *hardness])
    truth_frame = np.repeat(np.arange(len(labels)), [len(f) for f in labels])
    detection_frame = np.repeat(np.arange(len(labels)), [len(f) for f in detections])
    truths, found = concatenate(labels), concatenate(detections)

    relevant = np.isin(truths.type, [*classes, *(NEIGHBOUR.get(c, "") for c in classes)])
    index = np.flatnonzero(relevant)
    truth, detection = frame_pairs(truth_frame[index], detection_frame, len(labels))
    pairs = overlaps(truths, found, (index[truth], detection))

    regions = np.flatnonzero(truths.type == DONT_CARE)
    region_pairs = frame_pairs(truth_frame[regions], detection_frame, len(labels))
    cover = coverage(select(truths, regions), found, region_pairs)
    away = ~_within(found, distance)

    with_angle = bool((found.alpha != -10).all())
    precision = np.zeros((len(classes), len(METRICS), len(DIFFICULTIES), N_POINTS))
    n_objects = np.zeros((len(classes), len(DIFFICULTIES)), np.int64)
    for c, name in enumerate(classes):
        limit = min_overlap[name]
        wanted = np.isin(truths.type, [name, NEIGHBOUR.get(name, "")])[pairs.truth]
        tables = {
            metric: table_of(pairs, wanted & (overlap > limit), overlap, truth_frame)
            for metric, overlap in pairs.overlap.items()
        }
        for d in range(len(DIFFICULTIES)):
            truth_state = _truth_state(truths, name, d, min_height[d], levels)
            truth_state[(truth_state == VALID) & ~_within(truths, distance)] = IGNORED
            least = min_height[d] if levels is None else 0.0
            detection_state = _detection_state(found, name, least)
            n_objects[c, d] = n = int((truth_state == VALID).sum())
            for m, metric in enumerate(METRICS):
                if metric == "orientation":
                    continue
                covered = (cover[metric] > limit) | away
                p, s = _curves(
                    truths, found, tables[metric], truth_state, detection_state, covered, n
                )
                precision[c, m, d] = p if n else np.nan
                if metric == "2d":
                    precision[c, m + 1, d] = s if n and with_angle else np.nan
    n_detections = np.array([(found.type == name).sum() for name in classes])
    return Evaluation(tuple(classes), precision, n_objects, n_detections)
