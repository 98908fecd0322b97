"""Draw docs/images/architecture.svg from the imports.

python scripts/tools/draw_architecture.py            # write the picture
python scripts/tools/draw_architecture.py --check    # only say whether it is up to date
"""

from snn_fusion_failure.documentation.architecture import Config, main
from snn_fusion_failure.runs.command import run_command

if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
