"""The commands of the documentation: where they stand, and what makes each of them quick.

A reader types the commands of README.md and docs/ as they are printed; `make commands` appends the
options of a rule, so that the documented words stay and options that stand twice are overridden.
`scripts/tools/check_commands.py` runs them.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import shlex
from pathlib import Path

from snn_fusion_failure.documentation.command_rules import AREAS, PLACEHOLDERS, RULES
from snn_fusion_failure.documentation.rule import Rule
from snn_fusion_failure.runs import repository

ROOT = repository.ROOT
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

_DOTS = re.compile(r"\.\.\.(?=\s|$)")
_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_SHELL = re.compile(r"^(?:\$ )?((?:[A-Z_]+=\S+ )?(?:make|pip|pytest|python -c) .*)$", re.MULTILINE)


@dataclasses.dataclass(frozen=True)
class Command:
    """A command of the documentation and how it is run.

    Attributes:
        page: where it stands first.
        text: as it is printed.
        rule: None where the table has none.
    """

    page: str
    text: str
    rule: Rule | None

    @property
    def words(self) -> list[str]:
        """What is run: without `python` and pinning, placeholders filled, `small` appended."""
        filled = [_filled(word) for word in words(self.text)]
        return filled + shlex.split(self.rule.small if self.rule else "")

    @property
    def area(self) -> str:
        """Commands of one area run in one process, in the order in which they are printed."""
        name = Path(words(self.text)[0]).stem
        return next((area for area, scripts in AREAS.items() if name in scripts), "rest")


def words(text: str) -> list[str]:
    """A command without `python`, pinning and comments; a sub-command of `sff` as its script."""
    found = [word for word in shlex.split(text, comments=True) if word != "..."]
    if found[0] == "sff" and len(found) > 1:
        return [f"scripts/{found[1].replace('-', '_')}.py", *found[2:]]
    if "python" in found and found[found.index("python") + 1] != "-c":
        return found[found.index("python") + 1 :]
    return found


def _filled(word: str) -> str:
    for name, value in PLACEHOLDERS.items():
        pattern = re.escape(name) if not name.isalpha() else rf"\b{name}\b"
        word = re.sub(pattern, value, word)
    return word


def rule_for(text: str) -> Rule | None:
    """The first rule that has no other words than the command."""
    given = words(text)
    held = {*given, Path(given[0]).name, " ".join(given[:2])}
    for rule in RULES:
        if rule.words in held or set(rule.words.split()) <= held:
            return rule
    return None


def commands(text: str, *, abbreviated: bool = False) -> list[str]:
    """Commands of our scripts and of `sff`: lines of blocks, and whole ones in backticks.

    Args:
        text: Markdown, or a docstring.
        abbreviated: also those with three dots for options that are explained beside.
    """
    text = re.sub(r"\\\n\s*", " ", text)
    lines = re.findall(
        r"^(?:\s*\$ |\s*)((?:(?:taskset -c \d+ )?python scripts/\S+\.py|sff [a-z-]+).*)$",
        text,
        re.MULTILINE,
    )
    inline = re.findall(
        r"`((?:taskset -c \d+ )?(?:python\s+scripts/[\w/]+\.py|sff [a-z-]+(?= ))[^`]*)`", text
    )
    found = [" ".join(c.split()) for c in [*(x for x in lines if "`" not in x), *inline]]
    # Brackets hold options that may be left out.
    found = [re.sub(r"\[(--[^\]]*)\]", r"\1", c) for c in found]
    return [c for c in found if abbreviated or not _DOTS.search(c)]


def shell_lines(text: str) -> list[str]:
    """Other commands of fenced blocks: make, pip, pytest, and Python in one line."""
    return [
        line
        for language, block in _FENCE.findall(text)
        if language in ("", "bash", "sh", "console")
        for line in _SHELL.findall(block)
    ]


def page_name(page: Path) -> str:
    """A page as the repository names it."""
    return str(page.relative_to(ROOT))


def _moved(match: re.Match[str]) -> str:
    """Where a script stands now: those of older numbers of record have moved into a folder."""
    if (ROOT / match[0]).is_file():
        return match[0]
    found = sorted((ROOT / "scripts").glob(f"*/{match[1]}"))
    return str(found[0].relative_to(ROOT)) if found else match[0]


def _text(page: Path) -> str:
    """A page whose lines on how a number of record was made name scripts where they stand now."""

    def line(match: re.Match[str]) -> str:
        return re.sub(r"scripts/(\w+\.py)", _moved, match[0])

    return re.sub(r"^Commands?: .*$", line, page.read_text("utf-8"), flags=re.MULTILINE)


def script_commands() -> list[tuple[str, str]]:
    """(where, command of a script) of all pages and of the scripts' docstrings, each once."""
    found: dict[str, str] = {}
    texts = {page_name(page): _text(page) for page in PAGES}
    for path in sorted((ROOT / "scripts").rglob("*.py")):
        texts[page_name(path)] = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    for where, text in texts.items():
        for command in commands(text):
            found.setdefault(command, where)
    return [(where, command) for command, where in found.items()]


def documented() -> list[Command]:
    """All commands of README.md and docs/, each once, in the order of the pages."""
    found: dict[str, Command] = {}
    for page in PAGES:
        text = _text(page)
        for printed in (*commands(text, abbreviated=True), *shell_lines(text)):
            # The same words with another comment are the same command.
            key = shlex.join(words(printed))
            found.setdefault(key, Command(page_name(page), printed, rule_for(printed)))
    return list(found.values())
