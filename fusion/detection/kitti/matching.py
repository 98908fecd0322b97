"""Which detection hits which label: overlaps of pairs, greedy matching at all thresholds at once.

The matching is greedy in the order of the label file and cannot be reordered, but frames and
thresholds are independent. So the k-th object of every frame is matched at once, for all
thresholds: the number of numpy calls grows with the largest frame, not with the number of frames.

Source: Geiger, Lenz, Urtasun (2012); the rules follow the benchmark's evaluation program.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from fusion.detection.geometry.overlaps import (
    box3d_iou,
    ground_iou,
    image_iou,
    rotated_intersection,
)
from fusion.detection.kitti.objects import Objects

VALID, IGNORED, OTHER = 0, 1, -1


@dataclasses.dataclass(frozen=True)
class Pairs:
    """All (truth, detection) pairs of the same frame with their overlaps; truths ascending."""

    truth: np.ndarray
    detection: np.ndarray
    overlap: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Table:
    """Candidates `[G, C]` of every truth that has one, in file order, padded with -1."""

    truth: np.ndarray
    detection: np.ndarray
    overlap: np.ndarray
    rounds: list[np.ndarray]  # rows whose turn it is, one frame at most once a round


def frame_pairs(
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


def overlaps(labels: Objects, detections: Objects, pairs: tuple[np.ndarray, np.ndarray]) -> Pairs:
    """Intersection over union of the pairs in the image, on the ground and in 3D."""
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
    return Pairs(truth, detection, overlap)


def coverage(
    regions: Objects, detections: Objects, pairs: tuple[np.ndarray, np.ndarray]
) -> dict[str, np.ndarray]:
    """Largest share of each detection that lies in one DontCare region, by metric.

    On the ground a region without a 3D box is the square of one metre around (-1000, -1000) that
    its sizes of -1 describe, and a detection without a 3D box is the same square: it lies in the
    region whole. That is what the official program computes. In 3D the height of -1 leaves no
    common volume.

    Args:
        regions, detections: of all frames.
        pairs: which region and which detection share a frame.
    """
    region, other = pairs
    shares = {"2d": image_iou(detections.bbox[other], regions.bbox[region], over="first")}
    a, b = _ground(detections, other), _ground(regions, region)
    ground = np.array([0, 2, 3, 4, 6])
    apart = np.hypot(a[:, 0] - b[:, 0], a[:, 2] - b[:, 2])
    near = apart < 0.5 * (np.hypot(a[:, 3], a[:, 4]) + np.hypot(b[:, 3], b[:, 4]))
    for name in ("bev", "3d"):
        shares[name] = np.zeros(len(region))
    a, b = a[near], b[near]
    common = rotated_intersection(a[:, ground], b[:, ground])
    area = np.abs(a[:, 3] * a[:, 4])
    shares["bev"][near] = np.divide(common, area, out=np.zeros_like(area), where=area > 0)
    height = np.minimum(a[:, 1], b[:, 1]) - np.maximum(a[:, 1] - a[:, 5], b[:, 1] - b[:, 5])
    volume = area * a[:, 5]
    common = common * np.maximum(height, 0.0)
    shares["3d"][near] = np.divide(common, volume, out=np.zeros_like(area), where=volume > 0)
    found = {}
    for name, share in shares.items():
        found[name] = np.zeros(len(detections))
        np.maximum.at(found[name], other, share)
    return found


def table_of(pairs: Pairs, keep: np.ndarray, overlap: np.ndarray, frame: np.ndarray) -> Table:
    """The kept pairs by label, in the order in which the labels of a frame take their turn."""
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
    return Table(rows, ids, values, [np.flatnonzero(turn == k) for k in range(n_rounds)])


class Matches(NamedTuple):
    """Over T thresholds: hits, the pairs that hit, and which detections nobody took `[T, D]`."""

    hits: np.ndarray
    matched_truth: list[np.ndarray]
    matched_detection: list[np.ndarray]
    matched_threshold: list[np.ndarray]
    left: np.ndarray


def match(
    table: Table,
    truth_state: np.ndarray,
    detection_state: np.ndarray,
    score: np.ndarray,
    thresholds: np.ndarray,
    *,
    by_score: bool,
) -> Matches:
    """Give every truth its detection, in file order, at every threshold at once."""
    n_t = len(thresholds)
    open_ = (score >= thresholds[:, None]) & (detection_state != OTHER)
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
            counts = able & (detection_state[ids] == VALID)
            best = np.where(counts, table.overlap[rows], -1.0).argmax(axis=2)
            has = able.any(axis=2)
            best = np.where(counts.any(axis=2), best, able.argmax(axis=2))
        threshold, row = np.nonzero(has)
        detection = ids[row, best[threshold, row]]
        open_[threshold, detection] = False
        truth = table.truth[rows[row]]
        hit = (truth_state[truth] == VALID) & (detection_state[detection] == VALID)
        hits += np.bincount(threshold[hit], minlength=n_t)
        truths.append(truth[hit])
        found.append(detection[hit])
        at.append(threshold[hit])
    return Matches(hits, truths, found, at, open_)
