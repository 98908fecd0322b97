"""Draw result files of the detector: images with boxes, and the road from above.

    python scripts/draw_detections.py --help

The same as `sff draw-detections` of an installed package; the command itself is
`snn_fusion_failure/commands/draw_detections.py`.
"""

from snn_fusion_failure.commands.draw_detections import cli

if __name__ == "__main__":
    cli()
