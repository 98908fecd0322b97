"""Deck templates: a SPICE netlist whose parameters, temperature and library sections change."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from failure.simulators.spice import format_number, parse_number

_ASSIGN = re.compile(r"""([A-Za-z_]\w*)(\s*=\s*)(\{[^}]*\}|'[^']*'|"[^"]*"|[^\s,;$]+)""")
_FILE = re.compile(r"""^(\s*\.(?:include|inc|lib)\s+)(["']?)([^\s"']+)\2(.*)$""", re.IGNORECASE)
_COMMENT = re.compile(r"^\s*\*|(?:\s\$|;).*$")


@dataclass(frozen=True)
class Deck:
    """A netlist as a template.

    Attributes:
        text: the netlist; paths of included files are absolute.
        parameters: `.param` names in lower case and what they are set to.
        used: names that stand somewhere else than in their own definition.
        digest: of the included files, so that a cache forgets when one of them changes.
    """

    text: str
    parameters: Mapping[str, str] = field(hash=False)
    used: frozenset[str]
    digest: str

    def check(self, names: Iterable[str], *, what: str) -> None:
        """Refuse names that the netlist does not define once, or never uses.

        Raises:
            ValueError: the name, and what there is.
        """
        known = ", ".join(self.parameters) or "none"
        for name in names:
            if name not in self.parameters:
                raise ValueError(f"{what}={name!r}: expected a .param of the netlist ({known})")
            if name not in self.used:
                raise ValueError(
                    f"{what}={name!r}: expected a .param that the netlist uses; it is defined, but "
                    f"nothing refers to it: write {{{name}}} where it belongs"
                )

    def value(self, name: str) -> float:
        """The number a parameter is set to.

        Raises:
            ValueError: it is an expression.
        """
        try:
            return parse_number(self.parameters[name])
        except ValueError as error:
            raise ValueError(
                f"parameter {name!r} is set to {self.parameters[name]!r}: expected a number; vary "
                "the parameters of the expression"
            ) from error

    def render(
        self,
        values: Mapping[str, float],
        *,
        temperature: float | None = None,
        section: str | None = None,
    ) -> str:
        """The netlist of one sample.

        Args:
            values: parameters to set.
            temperature: of the circuit [degrees Celsius], in place of the netlist's own.
            section: of the `.lib file section` lines, in place of the netlist's own.
        Returns:
            Text.
        """
        lines = []
        for line, is_param in _statements(self.text):
            if is_param:
                line = _ASSIGN.sub(
                    lambda m: (
                        m[1] + m[2] + format_number(values[m[1].lower()])
                        if m[1].lower() in values
                        else m[0]
                    ),
                    line,
                )
            elif section is not None and re.match(r"\s*\.lib\s+\S+\s+\S+", line, re.IGNORECASE):
                line = re.sub(r"\S+\s*$", section, line)
            elif temperature is not None and re.match(r"\s*\.temp\b", line, re.IGNORECASE):
                continue
            lines.append(line)
        if temperature is not None:
            lines.insert(1, f".temp {format_number(temperature)}")
        return "\n".join(lines) + "\n"


def read_deck(path: Path) -> Deck:
    """Read a netlist.

    Args:
        path: the file; included files are looked for beside it.
    Returns:
        Deck.
    Raises:
        FileNotFoundError: it, or a file that it includes, does not exist.
        ValueError: a parameter is defined twice, or the file is empty.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"netlist={str(path)!r}: expected a file; there is none")
    text = path.read_text(encoding="utf-8", errors="replace")
    if not text.strip():
        raise ValueError(f"netlist={str(path)!r}: expected a netlist; the file is empty")
    digest, included, lines = hashlib.sha256(), [], []
    for line in text.rstrip("\n").split("\n"):
        match = _FILE.match(line)
        # `.lib name` alone opens a section inside a library file.
        if match and not (match[1].strip().lower() == ".lib" and not match[4].strip()):
            file = (path.parent / match[3]).resolve()
            if not file.is_file():
                raise FileNotFoundError(f"{path}: {line.strip()!r}: there is no file {file}")
            content = file.read_bytes()
            digest.update(content)
            included.append(content.decode("utf-8", errors="replace"))
            line = f'{match[1]}"{file}"{match[4]}'
        lines.append(line)
    return parse_deck("\n".join(lines), included, digest=digest.hexdigest(), where=str(path))


def parse_deck(
    text: str, included: Iterable[str] = (), *, digest: str = "", where: str = "netlist"
) -> Deck:
    """A netlist from its text; see `read_deck`.

    Example:
        >>> deck = parse_deck("divider\\n.param r=1k\\nv1 a 0 1\\nr1 a b {r}\\nr2 b 0 1k\\n.end")
        >>> deck.render({"r": 1100.0}).split("\\n")[1]
        '.param r=1100'
    """
    parameters: dict[str, str] = {}
    rest = []
    for line, is_param in _statements(text):
        line = _COMMENT.sub("", line)
        if not is_param:
            rest.append(line)
            continue
        for match in _ASSIGN.finditer(line):
            name = match[1].lower()
            if name in parameters:
                raise ValueError(
                    f"{where}: parameter {name!r} is defined twice: expected once; give the two "
                    "different names"
                )
            parameters[name] = match[3]
            rest.append(match[3])
    # The title is no statement.
    words = set(re.findall(r"(?<![\w.])[A-Za-z_]\w*", "\n".join([*rest[1:], *included]).lower()))
    return Deck(text, parameters, frozenset(words & set(parameters)), digest)


def _statements(text: str) -> Iterable[tuple[str, bool]]:
    """Lines, and whether each belongs to a `.param` statement (with its `+` lines)."""
    inside = False
    for line in text.rstrip("\n").split("\n"):
        if re.match(r"\s*\.param\b", line, re.IGNORECASE):
            inside = True
        elif not re.match(r"\s*\+|\s*\*", line):
            inside = False
        yield line, inside and not line.lstrip().startswith("*")
