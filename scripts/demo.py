"""A tour in a few minutes: each part of the project does its main job once, at small size.

    python scripts/demo.py --help

The same as `sff demo` of an installed package; the command itself is
`snn_fusion_failure/commands/demo.py`.
"""

from snn_fusion_failure.commands.demo import cli

if __name__ == "__main__":
    cli()
