"""Draw both circuits and the networks S1-S4, ARGate and Rev-ARGate into docs/images/.

    python scripts/tools/draw_systems.py            # write the drawings
    python scripts/tools/draw_systems.py --check    # only say whether they are up to date

The circuits are drawn from the netlists that are simulated, the networks' sizes from their
configurations.
"""

from snn_fusion_failure.documentation.diagrams import Config, main
from snn_fusion_failure.runs.command import run_command

if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
