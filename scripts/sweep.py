"""Sweep constants of a study over many settings and seeds, on one core or on a cluster.

    python scripts/sweep.py --help

The same as `sff sweep` of an installed package; the command itself is
`snn_fusion_failure/commands/sweep.py`.
"""

from snn_fusion_failure.commands.sweep import cli

if __name__ == "__main__":
    cli()
