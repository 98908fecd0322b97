"""Sweeps of a study over settings and seeds, on one core or on a cluster."""
