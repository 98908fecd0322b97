"""Gated multi-sensor fusion that survives sensor failure (ARGate)."""

__all__: list[str] = []
