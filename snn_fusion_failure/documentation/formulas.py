"""Formulas of the documentation as MathML, which a browser shows without any script or network.

A hook of mkdocs (see `mkdocs.yml`): the arithmatex extension marks the formulas of a page, this
turns the marks into MathML when the site is built. Formulas of docstrings become such marks in
`docstrings.py`.
"""

from __future__ import annotations

import html
import re
from typing import Any

# Commands that the converter does not know -> commands that look the same.
_SAME = {r"\big\Vert": r"\|", r"\Vert": r"\|"}
_MARKED = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def to_mathml(latex: str, *, display: bool) -> str:
    r"""A formula as MathML; the source stays in `alttext`, for copying and for screen readers.

    Args:
        latex: without delimiters.
        display: on a line of its own.

    Raises:
        ValueError: the formula cannot be read.

    Example:
        >>> "<mi>x</mi>" in to_mathml("x^2", display=False)
        True
    """
    from latex2mathml.converter import convert

    known = latex
    for command, other in _SAME.items():
        known = known.replace(command, other)
    try:
        made = str(convert(known, display="block" if display else "inline"))
    except Exception as error:
        raise ValueError(
            f"formula={latex!r}: {type(error).__name__} {error}; rewrite it"
        ) from error
    # Commands that the converter does not know come out as they are.
    if found := re.search(r">\s*(\\[A-Za-z]+)\s*<", made):
        raise ValueError(f"formula={latex!r}: {found[1]} is not known; use another command")
    return made.replace("<math ", f'<math alttext="{html.escape(latex, quote=True)}" ', 1)


def convert_page(markup: str) -> str:
    """A page's HTML with every marked formula as MathML."""

    def one(match: re.Match[str]) -> str:
        text = html.unescape(match[2]).strip()
        display = text.startswith("\\[")
        body = text.removeprefix("\\[").removeprefix("\\(").removesuffix("\\]").removesuffix("\\)")
        made = to_mathml(body.strip(), display=display)
        return f'<div class="formula">{made}</div>' if display else made

    return _MARKED.sub(one, markup)


def on_page_content(markup: str, *, page: Any, **_: Any) -> str:
    """Called by mkdocs for every page.

    Raises:
        ValueError: a formula cannot be read; names the page.
    """
    try:
        return convert_page(markup)
    except ValueError as error:
        raise ValueError(f"{page.file.src_path}: {error}") from error
