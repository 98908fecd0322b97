"""Searches for failures: spaces, Bayesian optimisation, baselines, run folders."""

__all__: list[str] = []
