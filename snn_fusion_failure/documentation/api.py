"""Write `docs/api.md`, the list of public names, from `__all__` and the docstrings.

    python scripts/tools/render_api.py            # write the page
    python scripts/tools/render_api.py --check    # only say whether it is up to date

The packages are read, not imported, so this takes a second. The test suite fails when the page is
out of date.
"""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

from snn_fusion_failure.runs import repository, write_text

PACKAGES = {
    "jaxsnn": "Spiking robots",
    "fusion": "Sensor fusion and lattices",
    "failure": "Rare failures",
}
Definition = ast.FunctionDef | ast.ClassDef

HEAD = """\
# Public names

Written by `python scripts/tools/render_api.py` from `__all__` and the docstrings; the tests check
that it is up to date, and that each function below is typed and says what it computes.

**What is stable.** A name on this page keeps its meaning and its arguments within a minor version
(0.1.x); what changes between minor versions stands in `CHANGELOG.md`. Everything else (names with a
leading underscore, modules with one, `scripts`, `tests`) may change at any time.
`fusion.detection` is younger than the rest: its names may still move; the changelog will say so.

**What holds for all of them.** No function keeps state between calls or changes a setting of jax.
Functions of arrays are pure: they can be jitted, vmapped, differentiated where that is defined, and
used inside `lax.scan`. `Params` are floats that may be traced and vmapped; a `Config` is a frozen
dataclass and static under `jit`. The circuit solver and the Gaussian process work in float64 and
expect `with jax.enable_x64(True):` around calls from your own code; their host functions
(`simulate`, `ask`, `run`) set it themselves. `import jaxsnn, fusion, failure` prints nothing and
leaves brax, matplotlib, orbax and xarray alone until they are needed.
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """Write the page of public names."""

    check: bool = False
    """Do not write; exit with 1 when the page is out of date."""


@dataclasses.dataclass(frozen=True)
class Module:
    """A public module: its names, and the definitions of those that it defines itself."""

    name: str
    path: Path
    summary: str
    names: tuple[str, ...]
    definitions: dict[str, Definition]
    imported: frozenset[str]
    assigned: frozenset[str]


def summary_of(node: ast.AST) -> str:
    """The first paragraph of a docstring on one line, or ''."""
    text = ast.get_docstring(node) or ""  # type: ignore[arg-type]
    return " ".join(text.split("\n\n")[0].split())


def read_module(path: Path) -> Module | None:
    """The public names of a module, read without importing it; None when it has no `__all__`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: tuple[str, ...] | None = None
    definitions: dict[str, Definition] = {}
    imported, assigned = set(), set()
    for node in tree.body:
        if isinstance(node, Definition):
            definitions[node.name] = node
        elif isinstance(node, ast.ImportFrom | ast.Import):
            imported |= {(alias.asname or alias.name) for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                found = {n.id for n in ast.walk(target) if isinstance(n, ast.Name)}
                assigned |= found
                if "__all__" in found and node.value is not None:
                    names = tuple(ast.literal_eval(node.value))
    if names is None:
        return None
    parts = path.relative_to(repository.ROOT).with_suffix("").parts
    dotted = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    return Module(
        dotted, path, summary_of(tree), names, definitions, frozenset(imported), frozenset(assigned)
    )


def public_modules(package: str) -> Iterator[Module]:
    """The modules of a package whose path has no leading underscore, in alphabetical order."""
    for path in sorted((repository.ROOT / package).rglob("*.py")):
        parts = path.relative_to(repository.ROOT).with_suffix("").parts
        if any(part.startswith("_") and part != "__init__" for part in parts):
            continue
        module = read_module(path)
        if module is None:
            raise ValueError(f"{path} has no `__all__`; list its public names there")
        yield module


def signature(node: Definition) -> str:
    """Names of the arguments, `=` after those that have a default."""
    if isinstance(node, ast.ClassDef):
        return node.name
    a = node.args
    positional = [*a.posonlyargs, *a.args]
    words = [arg.arg for arg in positional]
    for index in range(len(positional) - len(a.defaults), len(positional)):
        words[index] += "="
    if a.vararg:
        words.append(f"*{a.vararg.arg}")
    elif a.kwonlyargs:
        words.append("*")
    words += [
        arg.arg + ("=" if default is not None else "")
        for arg, default in zip(a.kwonlyargs, a.kw_defaults, strict=True)
    ]
    if a.kwarg:
        words.append(f"**{a.kwarg.arg}")
    return f"{node.name}({', '.join(words)})"


def _cell(text: str) -> str:
    """Text that survives in a table cell: no role marks, no column marks, one kind of code mark."""
    text = re.sub(r":(?:func|class|mod|meth):`~?([^`]*)`", r"`\1`", text)
    text = re.sub(r":math:`([^`]*)`", r"\\(\1\\)", text)
    return text.replace("``", "`").replace("|", "\\|")


def render_module(module: Module) -> list[str]:
    """Heading, summary and table of one module."""
    lines = ["", f"### `{module.name}`", "", _cell(module.summary)]
    own = [name for name in module.names if name in module.definitions]
    if own:
        lines += ["", "| name | what it is |", "|---|---|"]
        for name in own:
            node = module.definitions[name]
            lines.append(f"| `{signature(node)}` | {_cell(summary_of(node))} |")
    constants = [name for name in module.names if name in module.assigned]
    if constants:
        lines += ["", "Constants and types: " + ", ".join(f"`{name}`" for name in constants) + "."]
    others = [n for n in module.names if n not in module.definitions and n in module.imported]
    if others:
        lines += ["", "From its modules: " + ", ".join(f"`{name}`" for name in others) + "."]
    return lines


def render() -> str:
    """The whole page."""
    lines = [HEAD.rstrip()]
    for package, title in PACKAGES.items():
        lines += ["", f"## {title}: `{package}`"]
        for module in public_modules(package):
            lines += render_module(module)
    return "\n".join(lines) + "\n"


def main(config: Config) -> dict[str, int]:
    """Write or check the page; returns how many names it lists."""
    path = repository.ROOT / "docs" / "api.md"
    text = render()
    if config.check and (not path.exists() or path.read_text(encoding="utf-8") != text):
        raise ValueError(f"{path} is out of date: run `python scripts/tools/render_api.py`")
    if not config.check:
        write_text(path, text)
    return {"names": text.count("\n| `"), "modules": text.count("\n### ")}
