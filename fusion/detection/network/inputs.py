"""What networks and losses read of a batch of frames."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array


class Inputs(NamedTuple):
    """One frame, or with a leading axis a batch.

    Attributes:
        image: `[h, w, 3]`, mean colour subtracted.
        bev: `[rows, columns, channels]` maps of the scan.
        anchors, anchor_mask: `[a, 6]` and which rows hold an anchor.
        n_occupied: anchors of the grid that hold points.
        p2: `[3, 4]` projection; image_size: `[2]` original rows and columns.
        plane: `[4]` ground plane.
        truth, truth_mask: `[g, 7]` labelled boxes and which rows hold one of the target class.
        ignored: `[g]` rows that are neither objects nor background, such as vans for cars.
        regions: `[d, 4]` DontCare regions in pixels of the original image, zeros for none.
        told: `[2]` severity of the failure of (camera, lidar), 0 while it works; only the gate of
            `dense_oracle` reads it.
    """

    image: Array
    bev: Array
    anchors: Array
    anchor_mask: Array
    n_occupied: Array
    p2: Array
    image_size: Array
    plane: Array
    truth: Array
    truth_mask: Array
    ignored: Array
    regions: Array
    told: Array
