"""Watch a fitted network on a recorded stream: classes, fusion weights and dead sensors.

    python scripts/watch_sensors.py --help

The same as `sff watch-sensors` of an installed package; the command itself is
`snn_fusion_failure/commands/watch_sensors.py`.
"""

from snn_fusion_failure.commands.watch_sensors import cli

if __name__ == "__main__":
    cli()
