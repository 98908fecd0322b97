"""Q-learning and PPO on Scenarios 1-3: the baselines of the spiking networks.

    python scripts/train_rl.py --help

The same as `sff train-rl` of an installed package; the command itself is
`snn_fusion_failure/commands/train_rl.py`.
"""

from snn_fusion_failure.commands.train_rl import cli

if __name__ == "__main__":
    cli()
