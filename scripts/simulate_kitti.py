"""Simulate camera and lidar frames of streets as a KITTI folder.

    python scripts/simulate_kitti.py --help

The same as `sff simulate-kitti` of an installed package; the command itself is
`snn_fusion_failure/commands/simulate_kitti.py`.
"""

from snn_fusion_failure.commands.simulate_kitti import cli

if __name__ == "__main__":
    cli()
