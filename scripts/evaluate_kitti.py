"""Average precision of KITTI detections: 2D, orientation, bird's eye and 3D; R11 and R40.

    python scripts/evaluate_kitti.py --help

The same as `sff evaluate-kitti` of an installed package; the command itself is
`snn_fusion_failure/commands/evaluate_kitti.py`.
"""

from snn_fusion_failure.commands.evaluate_kitti import cli

if __name__ == "__main__":
    cli()
