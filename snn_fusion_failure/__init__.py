"""Tooling on top of `jaxsnn`, `fusion` and `failure`: commands, sweeps, runs, records."""
