"""What every command shares: run folders, whole files, provenance, progress, the last line.

A command computes with the packages and leaves the bookkeeping to this room, so that all of them
keep the same promises: nothing is overwritten silently, a file is either whole or absent, a number
of record carries the command, versions, device and seeds that made it.
"""

# ruff: noqa: F401  (what the commands of this distribution share beyond the public names)
from snn_fusion_failure.runs.changes import apply_changes
from snn_fusion_failure.runs.command import WorkFailedError, run_command
from snn_fusion_failure.runs.console import fail, print_result, progress
from snn_fusion_failure.runs.files import append_metrics, to_jsonable, write_json, write_text
from snn_fusion_failure.runs.folder import open_run
from snn_fusion_failure.runs.origin import command_line, provenance
from snn_fusion_failure.runs.repository import enable_compilation_cache

__all__ = ["WorkFailedError", "open_run", "run_command", "write_json"]
