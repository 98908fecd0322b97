"""Train one sensor-fusion network and score it on clean and corrupted test examples.

    python scripts/train_argate.py --help

The same as `sff train-argate` of an installed package; the command itself is
`snn_fusion_failure/commands/train_argate.py`.
"""

from snn_fusion_failure.commands.train_argate import cli

if __name__ == "__main__":
    cli()
