"""Write `docs/api.md`, the list of public names, from `__all__` and the docstrings.

    python scripts/tools/render_api.py            # write the page
    python scripts/tools/render_api.py --check    # only say whether it is up to date

The packages are read, not imported, so this takes a second. The test suite fails when the page is
out of date.
"""

from snn_fusion_failure.documentation.api import Config, main
from snn_fusion_failure.runs.command import run_command

if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
