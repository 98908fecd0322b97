"""Boxes, anchors, bird's-eye maps, overlaps and ground planes."""

__all__: list[str] = []
