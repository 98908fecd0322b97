"""Prepare KITTI frames, train AVOD or AVOD-ARGate on them, and evaluate the detections.

    python scripts/train_detector.py --help

The same as `sff train-detector` of an installed package; the command itself is
`snn_fusion_failure/commands/train_detector.py`.
"""

from snn_fusion_failure.commands.train_detector import cli

if __name__ == "__main__":
    cli()
