r"""Docstrings as Markdown: roles and directives of reStructuredText become what the pages use.

Formulas in roles and directives become \(...\) and \[...\], names in roles become code. An
extension of griffe, the reader of docstrings behind mkdocstrings; `mkdocs.yml` names it.
"""

from __future__ import annotations

import re
import textwrap
from typing import Any

import griffe

_DIRECTIVE = re.compile(
    r"^(?P<indent> *)\.\. math::(?P<first>[^\n]*)\n(?P<rest>(?:(?P=indent) +[^\n]*\n|[ ]*\n)*)",
    re.MULTILINE,
)


def to_markdown(text: str) -> str:
    r"""A docstring with its formulas and roles as Markdown.

    Example:
        >>> to_markdown("Sum :math:`a + b` of :func:`~x.y`.")
        'Sum \\(a + b\\) of `y`.'
    """

    def block(match: re.Match[str]) -> str:
        first, rest = match["first"].strip(), textwrap.dedent(match["rest"]).strip("\n")
        # A blank line ends the formula; what is indented below it is one formula, too.
        lines = [line.strip() for line in (first, *rest.splitlines()) if line.strip()]
        formula = f"\n{match['indent']}".join(lines)
        return f"\n{match['indent']}\\[{formula}\\]\n\n"

    text = _DIRECTIVE.sub(block, text + "\n").rstrip("\n")
    text = re.sub(r":math:`([^`]*)`", r"\\(\1\\)", text)
    return re.sub(r":(?:func|class|mod|meth|data):`~?(?:[\w.]*\.)?([^`]*)`", r"`\1`", text)


class MarkdownDocstrings(griffe.Extension):
    """Converts every docstring as it is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called by griffe for every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
