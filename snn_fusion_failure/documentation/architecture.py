"""The picture of docs/architecture.md, drawn from the imports: which room uses which.

python scripts/tools/draw_architecture.py            # write docs/images/architecture.svg
python scripts/tools/draw_architecture.py --check    # only say whether it is up to date
"""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path

from snn_fusion_failure.documentation import imports
from snn_fusion_failure.documentation.svg import SOFT, Canvas
from snn_fusion_failure.runs import repository, write_text

PATH = repository.ROOT / "docs" / "images" / "architecture.svg"
WORDS = {
    "jaxsnn": "spiking robots",
    "fusion": "sensor fusion and lattices",
    "failure": "rare failures of circuits",
    "snn_fusion_failure": "runs, sweeps, records, commands: the console command sff",
    "scripts": "one file per command; what made results/",
}
PLACES = {
    "scripts": (20, 20, 920, 110),
    "snn_fusion_failure": (20, 175, 920, 110),
    "jaxsnn": (20, 330, 270, 280),
    "fusion": (320, 330, 300, 280),
    "failure": (650, 330, 290, 280),
}
"""Room -> x, y, width and height of its box."""
COLOURS = {"jaxsnn": "green", "fusion": "blue", "failure": "red"}


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw the architecture."""

    check: bool = False
    """Do not write; exit with 2 when the picture is out of date."""


def part_of(module: str) -> tuple[str, str]:
    """(room, sub-room or '') of a module; files beside the sub-rooms belong to the room itself."""
    room, _, rest = module.partition(".")
    inner = rest.split(".")[0] if rest else ""
    return room, inner if (repository.ROOT / room / inner).is_dir() and inner else ""


def uses(graph: imports.Graph) -> dict[tuple[str, str], set[tuple[str, str]]]:
    """Part -> the parts that it imports from."""
    found: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for module, targets in graph.edges.items():
        held = found.setdefault(part_of(module), set())
        held |= {part_of(t) for t in targets} - {part_of(module)}
    return found


def _wrapped(words: list[str], width: int) -> str:
    return "\n".join(textwrap.wrap(", ".join(words), width))


def _room(canvas: Canvas, room: str, graph: imports.Graph) -> None:
    """The box of a room: its sub-rooms with what they use of each other, then its own files."""
    x, y, width, height = PLACES[room]
    used = uses(graph)
    canvas.box(x, y, width, height, colour=COLOURS.get(room, "grey"), radius=8)
    canvas.text(x + 14, y + 24, room, size=16, anchor="start", bold=True)
    canvas.text(x + 14, y + 43, WORDS[room], size=12, anchor="start", colour=SOFT)
    parts = sorted(inner for r, inner in used if r == room and inner)
    across = 5 if width > 500 else 1
    wide = (width - 28 - 10 * (across - 1)) / across
    for i, inner in enumerate(parts):
        below = sorted({b for r, b in used[room, inner] if r == room and b})
        left = x + 14 + (i % across) * (wide + 10)
        top = y + 56 + (i // across) * 42
        canvas.box(left, top, wide, 36, colour="white")
        canvas.text(left + wide / 2, top + (16 if below else 22), inner, size=12.5)
        if below:
            listed = "uses " + ", ".join(below)
            canvas.text(left + wide / 2, top + 29, listed, size=9.5, colour=SOFT)
    if room in COLOURS:
        own = sorted(
            m.split(".")[1]
            for m in graph.files
            if part_of(m) == (room, "") and "." in m and not m.split(".")[1].startswith("_")
        )
        top = y + 56 + len(parts) * 42 + 16
        canvas.text(x + 14, top, _wrapped(own, 44), size=11, anchor="start")


def draw(graph: imports.Graph) -> str:
    """The picture as SVG."""
    canvas = Canvas(960, 640, "Rooms of the repository and who imports whom; arrows point down")
    for room in PLACES:
        _room(canvas, room, graph)
    arrows = {(m.split(".")[0], t.split(".")[0]) for m, ts in graph.edges.items() for t in ts}
    canvas.line((480, 130), (480, 175), arrow=True, width=2)
    words = "scripts call the commands and the packages"
    canvas.text(492, 157, words, size=11, anchor="start", colour=SOFT)
    for room in COLOURS:
        x, y, width, _ = PLACES[room]
        if ("snn_fusion_failure", room) in arrows:
            canvas.line((x + width / 2, 285), (x + width / 2, y), arrow=True, width=2)
        for other in COLOURS:
            if other != room and (room, other) in arrows:
                end = PLACES[other][0] + PLACES[other][2]
                canvas.line((x, 590), (end, 590), arrow=True, width=2)
    canvas.text(635, 628, "failure.rev_argate and failure.revnet use fusion", size=11,
                colour=SOFT)  # fmt: skip
    return canvas.render()


def keep(path: Path, text: str, *, check: bool, command: str) -> None:
    """Write a drawing, or refuse one that is out of date.

    Raises:
        ValueError: `check`, and the file holds something else.
    """
    if not check:
        write_text(path, text)
    elif not path.exists() or path.read_text(encoding="utf-8") != text:
        raise ValueError(f"{path} is out of date: run `python {command}`")


def main(config: Config) -> dict[str, str]:
    """Write or check the picture."""
    text = draw(imports.read())
    keep(PATH, text, check=config.check, command="scripts/tools/draw_architecture.py")
    return {"picture": str(PATH.relative_to(repository.ROOT))}
