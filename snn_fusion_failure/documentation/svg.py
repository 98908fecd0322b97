"""A few shapes as SVG text: enough for block diagrams and schematics, the same file every time."""

from __future__ import annotations

import dataclasses
import html

INK, SOFT, LINE, PANEL = "#1b1f24", "#57606a", "#8c959f", "#f6f8fa"
COLOURS = {
    "blue": ("#ddf4ff", "#0969da"),
    "green": ("#dafbe1", "#1a7f37"),
    "yellow": ("#fff8c5", "#9a6700"),
    "red": ("#ffebe9", "#cf222e"),
    "grey": ("#f6f8fa", "#8c959f"),
    "white": ("#ffffff", "#8c959f"),
}
"""Name -> (fill, stroke)."""
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"


def _n(value: float) -> str:
    return f"{value:.1f}".rstrip("0").rstrip(".")


@dataclasses.dataclass
class Canvas:
    """A drawing that grows by shapes; white ground, so that it can be read in a dark page.

    Attributes:
        width, height: in pixels.
        title: what it shows, for readers who do not see it.
    """

    width: float
    height: float
    title: str
    parts: list[str] = dataclasses.field(default_factory=list)

    def text(
        self, x: float, y: float, text: str, *, size: float = 13, anchor: str = "middle",
        colour: str = INK, bold: bool = False, italic: bool = False,
    ) -> None:  # fmt: skip
        """Lines of text, the first at `y`."""
        style = ' font-weight="600"' if bold else ""
        style += ' font-style="italic"' if italic else ""
        for i, line in enumerate(text.split("\n")):
            self.parts.append(
                f'<text x="{_n(x)}" y="{_n(y + i * size * 1.25)}" font-size="{_n(size)}" '
                f'text-anchor="{anchor}" fill="{colour}"{style}>{html.escape(line)}</text>'
            )

    def box(
        self, x: float, y: float, width: float, height: float, label: str = "", *,
        colour: str = "white", size: float = 13, bold: bool = False, radius: float = 5,
    ) -> None:  # fmt: skip
        """A box with a label in its middle."""
        fill, stroke = COLOURS[colour]
        self.parts.append(
            f'<rect x="{_n(x)}" y="{_n(y)}" width="{_n(width)}" height="{_n(height)}" '
            f'rx="{_n(radius)}" fill="{fill}" stroke="{stroke}"/>'
        )
        if label:
            first = y + height / 2 + size * 0.35 - label.count("\n") * size * 0.625
            self.text(x + width / 2, first, label, size=size, bold=bold)

    def line(
        self, *points: tuple[float, float], arrow: bool = False, colour: str = INK,
        width: float = 1.3, dashed: bool = False,
    ) -> None:  # fmt: skip
        """A line through points, with an arrowhead at its end."""
        listed = " ".join(f"{_n(x)},{_n(y)}" for x, y in points)
        style = ' marker-end="url(#head)"' if arrow else ""
        style += ' stroke-dasharray="4 3"' if dashed else ""
        self.parts.append(
            f'<polyline points="{listed}" fill="none" stroke="{colour}" '
            f'stroke-width="{_n(width)}"{style}/>'
        )

    def circle(self, x: float, y: float, radius: float, *, colour: str = "white") -> None:
        """A circle."""
        fill, stroke = COLOURS[colour]
        self.parts.append(
            f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}" fill="{fill}" stroke="{stroke}"/>'
        )

    def dot(self, x: float, y: float, radius: float = 2.4) -> None:
        """A junction."""
        self.parts.append(f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}" fill="{INK}"/>')

    def render(self) -> str:
        """The file."""
        size = f"{_n(self.width)} {_n(self.height)}"
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" '
            f'width="{_n(self.width)}" height="{_n(self.height)}" role="img" '
            f'font-family="{html.escape(FONT)}">\n<title>{html.escape(self.title)}</title>\n'
            '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
            'markerHeight="7" orient="auto-start-reverse">'
            f'<path d="M0 0 L10 5 L0 10 z" fill="{INK}"/></marker></defs>\n'
            '<rect width="100%" height="100%" fill="#ffffff"/>\n'
        )
        return head + "\n".join(self.parts) + "\n</svg>\n"
