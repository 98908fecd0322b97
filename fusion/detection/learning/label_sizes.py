"""Sizes of the anchors, from the labels of the training list."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.detection.config import TARGET_SIZES
from fusion.detection.geometry.anchors import cluster_sizes
from fusion.detection.kitti.files import read_labels


def anchor_sizes(
    root: Path, names: Sequence[str], n_sizes: int, target: str
) -> tuple[tuple[float, float, float], ...]:
    """Length, width, height [m] of the centres of a class's labels, those of the benchmark for few.

    Args:
        root, names: KITTI folder and its frames.
        n_sizes: how many.
        target: the class.
    """
    sizes = [np.zeros((0, 3))]
    for name in names:
        labels = read_labels(root / "training" / "label_2" / f"{name}.txt")
        wanted = (labels.type == target) & (labels.dimensions > 0).all(axis=1)
        sizes.append(labels.dimensions[wanted][:, [2, 1, 0]])
    labelled = np.concatenate(sizes)
    # Clusters of a handful of objects mean nothing; the benchmark's own are the better guess.
    if len(np.unique(labelled, axis=0)) < 20 * n_sizes:
        return TARGET_SIZES[target][-n_sizes:]
    centres = np.round(cluster_sizes(labelled, n_sizes), 3)
    return tuple((float(a), float(b), float(c)) for a, b, c in centres)
