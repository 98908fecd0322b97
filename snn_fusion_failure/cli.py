"""`sff`: the commands of the installed package, one sub-command each."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

COMMANDS = {
    "demo": "demo",
    "train-snn": "train_snn",
    "train-rl": "train_rl",
    "train-argate": "train_argate",
    "watch-sensors": "watch_sensors",
    "simulate-kitti": "simulate_kitti",
    "train-detector": "train_detector",
    "evaluate-kitti": "evaluate_kitti",
    "draw-detections": "draw_detections",
    "find-failures": "find_failures",
    "sweep": "sweep",
}
"""Sub-command -> module of `snn_fusion_failure.commands`, in the order of the list."""


def summary(name: str) -> str:
    """First line of a command's text, read without importing it (imports bring jax)."""
    file = Path(__file__).with_name("commands") / f"{COMMANDS[name]}.py"
    doc = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return doc.splitlines()[0]


def listing() -> str:
    """What `sff` alone prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary(name)}" for name in COMMANDS]
    return "\n".join(["usage: sff COMMAND [options]; sff COMMAND --help explains one", "", *lines])


def main(argv: Sequence[str] | None = None) -> None:
    """Run the sub-command that the first argument names.

    Raises:
        SystemExit: 2 for an unknown command; what the command itself leaves with.
    """
    from snn_fusion_failure import __version__

    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0] in ("-h", "--help", "help"):
        print(listing())
        return
    if given[0] == "--version":
        print(__version__)
        return
    name = given[0].replace("_", "-")
    if name not in COMMANDS:
        print(
            f"error: command={given[0]!r}: expected one of {', '.join(COMMANDS)}; `sff` alone "
            "lists them",
            file=sys.stderr,
        )
        raise SystemExit(2)
    module = importlib.import_module(f"snn_fusion_failure.commands.{COMMANDS[name]}")
    module.cli(given[1:], prog=f"sff {name}")
