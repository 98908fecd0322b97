"""Train and test spiking networks on a scenario, many independent robots (seeds) at a time.

    python scripts/train_snn.py --help

The same as `sff train-snn` of an installed package; the command itself is
`snn_fusion_failure/commands/train_snn.py`.
"""

from snn_fusion_failure.commands.train_snn import cli

if __name__ == "__main__":
    cli()
