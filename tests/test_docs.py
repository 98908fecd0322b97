"""The documentation holds: its examples run, its links lead somewhere, its commands parse.

That the commands run, too, is what scripts/tools/check_commands.py is for.

A Python block of a tutorial is executed, after those before it on the page. An HTML comment
`<!-- not run here: why -->` on the line before a block takes it out, where it would take minutes.
"""

from __future__ import annotations

import ast
import re
import runpy
import sys
import unicodedata
from pathlib import Path
from typing import Any

import pytest
import tyro

from snn_fusion_failure.documentation import api, documented, imports, reading
from snn_fusion_failure.documentation.documented import (
    PAGES,
    ROOT,
    commands,
    page_name,
    script_commands,
)

TUTORIALS = [p for p in PAGES if p.parent.name == "tutorials" and p.name != "index.md"]
BLOCK = re.compile(r"(<!-- not run here: [^\n]+ -->\n)?```python\n(.*?)```", re.DOTALL)
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[tuple[bool, str, int]]:
    """The Python blocks of a page: whether it is run, the code, and the line it starts on."""
    text = page.read_text(encoding="utf-8")
    return [
        (m.group(1) is None, m.group(2), text[: m.start(2)].count("\n"))
        for m in BLOCK.finditer(text)
    ]


# These compile or train for twenty seconds and more each.
LONG = (
    "bayesian_gate", "argate_in_flax", "own_data", "brax_ppo", "lattice_in_flax", "swap_reward",
    "spiking_encoder", "reversible_encoder", "own_driving_network", "own_map", "sets_of_items",
    "own_simulator", "own_snn",
)  # fmt: skip


def with_marks(page: Path) -> Any:
    """brax warns about its optional engines, and about jax's deprecations, as it is imported."""
    marks = [pytest.mark.filterwarnings("ignore")] if "brax" in page.stem else []
    marks += [pytest.mark.slow] if page.stem in LONG else []
    return pytest.param(page, id=page.stem, marks=marks)


@pytest.mark.relaxed
@pytest.mark.parametrize("page", [with_marks(page) for page in TUTORIALS])
def test_tutorial_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = blocks(page)
    assert any(run for run, _, _ in found)
    names: dict[str, Any] = {"__name__": f"tutorial_{page.stem}"}
    for run, code, line in found:
        if run:
            # Blank lines in front, so that a traceback names the line of the page.
            exec(compile("\n" * line + code, str(page), "exec"), names)


def test_a_driving_network_of_ones_own_is_forty_lines() -> None:
    """As the page says: lines of code, without empty ones and comments."""
    ((_, code, _),) = blocks(ROOT / "docs" / "tutorials" / "own_driving_network.md")
    lines = [line.strip() for line in code.splitlines()]
    assert len([line for line in lines if line and not line.startswith("#")]) <= 40


def _missing(node: ast.ImportFrom | ast.Import) -> list[str]:
    """Names that an import of ours asks for and that are not there."""
    wanted = (
        [(a.name, None) for a in node.names]
        if isinstance(node, ast.Import)
        else [(node.module or "", a.name) for a in node.names]
    )
    missing = []
    for module, name in wanted:
        if module.split(".")[0] not in imports.ROOMS:
            continue
        path = reading.find_file(module)
        if path is None:
            missing.append(module)
        elif name is not None and reading.find_file(f"{module}.{name}") is None:
            read = reading.read_module(path)
            if name not in {*read.names, *read.definitions, *read.imported, *read.constants}:
                missing.append(f"{module}.{name}")
    return missing


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_examples_import_what_is_there(page: Path) -> None:
    for _, code, line in blocks(page):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom | ast.Import):
                assert _missing(node) == [], f"{page.name}, line {line + node.lineno}"


HOMES = {f"{name.home}.{name.inner}": name.path for p in api.PACKAGES for name in api.listed(p)}
LISTED = {name.path for package in api.PACKAGES for name in api.listed(package)}


def _not_promised(node: ast.ImportFrom | ast.Import, *, tutorial: bool) -> list[str]:
    """Names that a reader should not learn: public ones by another path, or not public ones."""
    if isinstance(node, ast.Import):
        return [
            a.name
            for a in node.names
            if a.name.split(".")[0] in imports.ROOMS and a.name not in {*api.PACKAGES, *api.BY_PATH}
        ]
    wrong = []
    module = node.module or ""
    for name in (f"{module}.{a.name}" for a in node.names):
        if module.split(".")[0] not in imports.ROOMS or name in {*LISTED, *api.BY_PATH}:
            continue
        if module in api.PACKAGES:
            wrong.append(f"{name} is not public: list it, or use the full path of its module")
        elif name in HOMES:
            wrong.append(f"{name} is public as {HOMES[name]}")
        elif tutorial and not f"{module}.".startswith(tuple(f"{m}." for m in api.BY_PATH)):
            wrong.append(f"{name} is in no module of api.BY_PATH")
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_examples_use_public_names_or_full_paths(page: Path) -> None:
    for _, code, line in blocks(page):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom | ast.Import):
                found = _not_promised(node, tutorial=page in TUTORIALS)
                assert found == [], f"{page.name}, line {line + node.lineno}"


@pytest.mark.parametrize(
    ("code", "good"),
    [
        ("from jaxsnn import lif_step", True),
        ("from jaxsnn.neurons import lif_step", False),
        ("from jaxsnn import scenarios", False),
        ("from jaxsnn.ppo import PPOConfig", True),
        ("from jaxsnn.running_mean import update", False),
        ("import jaxsnn", True),
        ("import jaxsnn.maps", False),
    ],
)
def test_the_rule_of_names_itself(code: str, good: bool) -> None:
    (node,) = ast.parse(code).body
    assert isinstance(node, ast.ImportFrom | ast.Import)
    assert (_not_promised(node, tutorial=True) == []) is good


def slug(heading: str) -> str:
    """The anchor that mkdocs gives a heading."""
    plain = re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", heading)
    plain = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())


def anchors(page: Path) -> set[str]:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#{1,6} +(.*?) *#*$", text, re.MULTILINE)
    return {slug(h) for h in headings} | set(re.findall(r'id="([^"]+)"', text))


def broken_links(page: Path, text: str) -> list[str]:
    """Relative links and pictures of `text` that lead nowhere."""
    broken = []
    plain = re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))
    for target in re.findall(r"\]\(([^()\s]+)(?: \"[^\"]*\")?\)", plain):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if not path.exists() or (anchor and anchor not in anchors(path)):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_and_pictures_are_there(page: Path) -> None:
    assert broken_links(page, page.read_text(encoding="utf-8")) == []


def test_a_broken_link_is_found() -> None:
    page = ROOT / "docs" / "index.md"
    text = "[a](argate.md) [b](argate.md#nowhere) ![c](images/none.png) [d](https://x.org/y)"
    assert broken_links(page, text) == ["argate.md#nowhere", "images/none.png"]


COMMANDS = script_commands()


def test_commands_are_found() -> None:
    assert len(COMMANDS) > 60
    text = "```\n$ python scripts/a.py --x 1 \\\n    --y 2   # why\n```\nand `python scripts/b.py`"
    assert commands(text) == ["python scripts/a.py --x 1 --y 2 # why", "python scripts/b.py"]


class Parsed(BaseException):
    """The options of a command are good."""


def parse(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start a script as its command would, up to the point where its options are parsed."""
    words = documented.words(command)
    assert (ROOT / words[0]).is_file(), f"{words[0]} is not there"
    if len(words) == 1:
        return
    real = tyro.cli

    def parse_only(*args: Any, **kwargs: Any) -> None:
        real(*args, **kwargs)
        raise Parsed

    monkeypatch.setattr(tyro, "cli", parse_only)
    monkeypatch.setattr(sys, "argv", words)
    try:
        runpy.run_path(str(ROOT / words[0]), run_name="__main__")
    except Parsed:
        return
    except SystemExit as leaving:
        if leaving.code:
            raise
        return  # --help
    finally:
        monkeypatch.undo()
    raise AssertionError(f"{words[0]} takes no options, and has run")


@pytest.mark.relaxed
@pytest.mark.parametrize(
    "script", sorted({documented.words(command)[0] for _, command in COMMANDS})
)
def test_commands_parse(
    script: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for where, command in COMMANDS:
        if documented.words(command)[0] != script:
            continue
        try:
            parse(command, monkeypatch)
        except SystemExit:
            message = capsys.readouterr()
            pytest.fail(f"{where}: `{command}` does not parse: {message.out}{message.err}")
        except ValueError as error:
            pytest.fail(f"{where}: `{command}` is refused: {error}")
