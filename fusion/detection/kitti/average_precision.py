r"""Average precision as the KITTI object benchmark counts it: 2D, orientation, ground and 3D.

Precision is taken at up to 41 score thresholds, one for each step of 1/40 in recall, made monotone
from the right, and averaged over

.. math::
    AP_{R11} = \frac{1}{11} \sum_{i=0,4,\dots,40} p_i, \qquad
    AP_{R40} = \frac{1}{40} \sum_{i=1}^{40} p_i .

Orientation similarity replaces the count of true positives by
:math:`\sum (1 + \cos\Delta\alpha) / 2`.

The matching is greedy in the order of the label file and cannot be reordered, but frames and
thresholds are independent. So the k-th object of every frame is matched at once, for all
thresholds: the number of numpy calls grows with the largest frame, not with the number of frames.

Source: Geiger, Lenz, Urtasun (2012); the rules follow the benchmark's evaluation program, 2017
edition (41 thresholds), and R40 is that of Simonelli et al. (2019). Deviation: average precision is
NaN, not 0, where no object counts at a difficulty.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion.detection.geometry.overlaps import box3d_iou, ground_iou, image_iou
from fusion.detection.kitti.objects import DONT_CARE, Objects, concatenate

__all__ = [
    "DIFFICULTIES",
    "METRICS",
    "MIN_HEIGHT",
    "MIN_OVERLAP",
    "Evaluation",
    "average_precision_cap",
    "evaluate",
    "recall_thresholds",
]

METRICS = ("2d", "orientation", "bev", "3d")
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_OVERLAP: Mapping[str, float] = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
# A truth of the neighbouring class is neither a hit nor a miss.
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting"}
MIN_HEIGHT = (40.0, 25.0, 25.0)  # [pixel]
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.3, 0.5)
N_POINTS = 41
_VALID, _IGNORED, _OTHER = 0, 1, -1


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


@dataclasses.dataclass(frozen=True)
class _Pairs:
    """All (truth, detection) pairs of the same frame with their overlaps; truths ascending."""

    truth: np.ndarray
    detection: np.ndarray
    overlap: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class _Table:
    """Candidates `[G, C]` of every truth that has one, in file order, padded with -1."""

    truth: np.ndarray
    detection: np.ndarray
    overlap: np.ndarray
    rounds: list[np.ndarray]  # rows whose turn it is, one frame at most once a round


def _frame_pairs(
    truth_frame: np.ndarray, detection_frame: np.ndarray, n_frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Every truth with every detection of its frame; both frame arrays ascend."""
    counts = np.bincount(detection_frame, minlength=n_frames)
    starts = np.cumsum(counts) - counts
    repeat = counts[truth_frame]
    truth = np.repeat(np.arange(len(truth_frame)), repeat)
    within = np.arange(len(truth)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    return truth, np.repeat(starts[truth_frame], repeat) + within


def _ground(objects: Objects, index: np.ndarray) -> np.ndarray:
    """`[n, 7]` x, y, z, length, width, height, rotation of the chosen objects."""
    size = objects.dimensions[index][:, [2, 1, 0]]
    return np.concatenate([objects.location[index], size, objects.rotation_y[index][:, None]], 1)


def _overlaps(labels: Objects, detections: Objects, pairs: tuple[np.ndarray, np.ndarray]) -> _Pairs:
    truth, detection = pairs
    overlap = {"2d": image_iou(detections.bbox[detection], labels.bbox[truth])}
    # Only pairs whose circumscribed circles meet can share ground.
    reach_t = np.hypot(labels.dimensions[:, 1], labels.dimensions[:, 2]) / 2
    reach_d = np.hypot(detections.dimensions[:, 1], detections.dimensions[:, 2]) / 2
    apart = labels.location[truth] - detections.location[detection]
    near = np.hypot(apart[:, 0], apart[:, 2]) < reach_t[truth] + reach_d[detection]
    a, b = _ground(detections, detection[near]), _ground(labels, truth[near])
    for name in ("bev", "3d"):
        overlap[name] = np.zeros(len(truth))
    overlap["bev"][near] = ground_iou(a[:, [0, 2, 3, 4, 6]], b[:, [0, 2, 3, 4, 6]])
    overlap["3d"][near] = box3d_iou(a, b)
    return _Pairs(truth, detection, overlap)


def _table(pairs: _Pairs, keep: np.ndarray, overlap: np.ndarray, frame: np.ndarray) -> _Table:
    truth, detection, overlap = pairs.truth[keep], pairs.detection[keep], overlap[keep]
    rows, first, counts = np.unique(truth, return_index=True, return_counts=True)
    width = int(counts.max()) if len(rows) else 0
    row = np.repeat(np.arange(len(rows)), counts)
    column = np.arange(len(truth)) - np.repeat(first, counts)
    ids = np.full((len(rows), width), -1)
    values = np.zeros((len(rows), width))
    ids[row, column], values[row, column] = detection, overlap
    frames, start = np.unique(frame[rows], return_index=True)
    turn = np.arange(len(rows)) - start[np.searchsorted(frames, frame[rows])]
    n_rounds = int(turn.max()) + 1 if len(rows) else 0
    return _Table(rows, ids, values, [np.flatnonzero(turn == k) for k in range(n_rounds)])


class _Counts(NamedTuple):
    """Over T thresholds: hits, the pairs that hit, and which detections nobody took `[T, D]`."""

    hits: np.ndarray
    matched_truth: list[np.ndarray]
    matched_detection: list[np.ndarray]
    matched_threshold: list[np.ndarray]
    left: np.ndarray


def _match(
    table: _Table,
    truth_state: np.ndarray,
    detection_state: np.ndarray,
    score: np.ndarray,
    thresholds: np.ndarray,
    *,
    by_score: bool,
) -> _Counts:
    """Give every truth its detection, in file order, at every threshold at once."""
    n_t = len(thresholds)
    open_ = (score >= thresholds[:, None]) & (detection_state != _OTHER)
    hits = np.zeros(n_t, np.int64)
    truths: list[np.ndarray] = []
    found: list[np.ndarray] = []
    at: list[np.ndarray] = []
    for rows in table.rounds:
        ids = table.detection[rows]
        able = open_[:, ids] & (ids >= 0)
        if by_score:
            rank = np.where(able, score[ids], -np.inf)
            best, has = rank.argmax(axis=2), able.any(axis=2)
        else:
            # Best overlap among detections that count, else the first one that does not.
            counts = able & (detection_state[ids] == _VALID)
            best = np.where(counts, table.overlap[rows], -1.0).argmax(axis=2)
            has = able.any(axis=2)
            best = np.where(counts.any(axis=2), best, able.argmax(axis=2))
        threshold, row = np.nonzero(has)
        detection = ids[row, best[threshold, row]]
        open_[threshold, detection] = False
        truth = table.truth[rows[row]]
        hit = (truth_state[truth] == _VALID) & (detection_state[detection] == _VALID)
        hits += np.bincount(threshold[hit], minlength=n_t)
        truths.append(truth[hit])
        found.append(detection[hit])
        at.append(threshold[hit])
    return _Counts(hits, truths, found, at, open_)


def _from_right(curve: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(curve[::-1])[::-1]


def _curves(
    labels: Objects,
    detections: Objects,
    table: _Table,
    truth_state: np.ndarray,
    detection_state: np.ndarray,
    covered: np.ndarray,
    n_objects: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Precision and orientation similarity `[41]`, monotone from the right."""
    precision, similarity = np.zeros(N_POINTS), np.zeros(N_POINTS)
    score = detections.score
    lowest = np.array([-np.inf])
    first = _match(table, truth_state, detection_state, score, lowest, by_score=True)
    if not n_objects or not first.hits[0]:
        return precision, similarity
    matched = score[np.concatenate(first.matched_detection)]
    thresholds = recall_thresholds(matched, n_objects)
    counts = _match(table, truth_state, detection_state, score, thresholds, by_score=False)
    # What is still open, counts and lies in no DontCare region is a false positive.
    false = (counts.left & (detection_state == _VALID) & ~covered).sum(axis=1)
    truth, found = np.concatenate(counts.matched_truth), np.concatenate(counts.matched_detection)
    alike = (1.0 + np.cos(labels.alpha[truth] - detections.alpha[found])) / 2.0
    at = np.concatenate(counts.matched_threshold)
    alike_sum = np.bincount(at, weights=alike, minlength=len(thresholds))
    total = np.maximum(counts.hits + false, 1)
    precision[: len(thresholds)] = counts.hits / total
    similarity[: len(thresholds)] = alike_sum / total
    return _from_right(precision), _from_right(similarity)


def _truth_state(labels: Objects, name: str, difficulty: int, min_height: float) -> np.ndarray:
    height = labels.bbox[:, 3] - labels.bbox[:, 1]
    hard = (
        (labels.occluded > MAX_OCCLUSION[difficulty])
        | (labels.truncated > MAX_TRUNCATION[difficulty])
        | (height <= min_height)
    )
    state = np.where(labels.type == name, np.where(hard, _IGNORED, _VALID), _OTHER)
    return np.where(labels.type == NEIGHBOUR.get(name, ""), _IGNORED, state)


def _detection_state(detections: Objects, name: str, min_height: float) -> np.ndarray:
    # Small detections of every class are ignored, but may still take a truth.
    small = np.abs(detections.bbox[:, 1] - detections.bbox[:, 3]) < min_height
    return np.where(small, _IGNORED, np.where(detections.type == name, _VALID, _OTHER))


def evaluate(
    labels: Sequence[Objects],
    detections: Sequence[Objects],
    *,
    classes: Sequence[str] = ("Car", "Pedestrian", "Cyclist"),
    min_overlap: Mapping[str, float] = MIN_OVERLAP,
    min_height: Sequence[float] = MIN_HEIGHT,
) -> Evaluation:
    """Precision curves of detections against labels, frame by frame in the same order.

    Args:
        labels: the labels of each frame.
        detections: the detections of the same frames, with scores.
        classes: classes to evaluate.
        min_overlap: overlap above which (strictly) a detection hits, for each class.
        min_height: smallest 2D height at each difficulty [pixel]; for images of another size than
            the benchmark's, multiply by their scale.

    Returns:
        `Evaluation`; average precision by `.average_precision(11)` or `(40)`.

    Raises:
        ValueError: not the same number of frames, no frame, a detection without a finite score, a
            class without `min_overlap`, or `min_height` not of three numbers.
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
    for i, frame in enumerate(detections):
        if not np.isfinite(frame.score).all():
            raise ValueError(f"frame {i}: a detection has no finite score")
    truth_frame = np.repeat(np.arange(len(labels)), [len(f) for f in labels])
    detection_frame = np.repeat(np.arange(len(labels)), [len(f) for f in detections])
    truths, found = concatenate(labels), concatenate(detections)

    relevant = np.isin(truths.type, [*classes, *(NEIGHBOUR.get(c, "") for c in classes)])
    index = np.flatnonzero(relevant)
    truth, detection = _frame_pairs(truth_frame[index], detection_frame, len(labels))
    pairs = _overlaps(truths, found, (index[truth], detection))

    regions = np.flatnonzero(truths.type == DONT_CARE)
    region, other = _frame_pairs(truth_frame[regions], detection_frame, len(labels))
    cover = np.zeros(len(found))
    # DontCare has no 3D box, so it excuses detections in the image only.
    share = image_iou(found.bbox[other], truths.bbox[regions[region]], over="first")
    np.maximum.at(cover, other, share)

    with_angle = bool((found.alpha != -10).all())
    precision = np.zeros((len(classes), len(METRICS), len(DIFFICULTIES), N_POINTS))
    n_objects = np.zeros((len(classes), len(DIFFICULTIES)), np.int64)
    for c, name in enumerate(classes):
        limit = min_overlap[name]
        wanted = np.isin(truths.type, [name, NEIGHBOUR.get(name, "")])[pairs.truth]
        tables = {
            metric: _table(pairs, wanted & (overlap > limit), overlap, truth_frame)
            for metric, overlap in pairs.overlap.items()
        }
        for d in range(len(DIFFICULTIES)):
            truth_state = _truth_state(truths, name, d, min_height[d])
            detection_state = _detection_state(found, name, min_height[d])
            n_objects[c, d] = n = int((truth_state == _VALID).sum())
            for m, metric in enumerate(METRICS):
                if metric == "orientation":
                    continue
                covered = cover > limit if metric == "2d" else np.zeros(len(found), bool)
                p, s = _curves(
                    truths, found, tables[metric], truth_state, detection_state, covered, n
                )
                precision[c, m, d] = p if n else np.nan
                if metric == "2d":
                    precision[c, m + 1, d] = s if n and with_angle else np.nan
    n_detections = np.array([(found.type == name).sum() for name in classes])
    return Evaluation(tuple(classes), precision, n_objects, n_detections)
