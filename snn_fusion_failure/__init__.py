"""Tooling on top of `jaxsnn`, `fusion` and `failure`: commands, sweeps, runs, records."""

__version__ = "0.1.0"

__all__ = ["__version__"]
