"""Gaussian processes, acquisition functions and their optimisation."""

__all__: list[str] = []
