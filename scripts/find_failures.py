"""Search a circuit for parameter variations that break a specification.

    python scripts/find_failures.py --help

The same as `sff find-failures` of an installed package; the command itself is
`snn_fusion_failure/commands/find_failures.py`.
"""

from snn_fusion_failure.commands.find_failures import cli

if __name__ == "__main__":
    cli()
