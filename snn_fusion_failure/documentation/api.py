"""The public names: what the `__all__` of the packages lists, grouped by task.

    python scripts/tools/render_api.py            # write docs/api.md and docs/reference/
    python scripts/tools/render_api.py --check    # only say whether they are up to date

The packages are read, not imported, so this takes a second. The test suite fails when a page is
out of date. mkdocstrings fills the pages of docs/reference/ from the docstrings.
"""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator

from snn_fusion_failure.documentation import docstrings
from snn_fusion_failure.documentation.promise import BY_PATH, HEAD, PACKAGES, TAIL, TASKS
from snn_fusion_failure.documentation.reading import (
    Definition,
    find_file,
    one_line,
    read_module,
    signature,
    summary_of,
)
from snn_fusion_failure.runs import repository, write_text


@dataclasses.dataclass(frozen=True)
class Config:
    """Write the pages of public names."""

    check: bool = False
    """Do not write; exit with 2 when a page is out of date."""


@dataclasses.dataclass(frozen=True)
class Name:
    """A public name.

    Attributes:
        package: whose `__all__` lists it.
        name: as listed.
        home: the module that defines it, or the module itself.
        node: definition of a function or a class; None for a module or a constant.
        kind: function, class, module or constant.
        text: first paragraph of its docstring.
        inner: its name where it is defined.
    """

    package: str
    name: str
    home: str
    node: Definition | None
    kind: str
    text: str
    inner: str = ""

    @property
    def path(self) -> str:
        """The dotted name by which it is imported."""
        return f"{self.package}.{self.name}"

    @property
    def task(self) -> str:
        """The heading that it stands under."""
        found = [p for p in TASKS if f"{self.home}.".startswith(f"{p}.")]
        return TASKS[max(found, key=len)] if found else PACKAGES[self.package]


def resolve(package: str, name: str) -> Name:
    """Follow imports from a package to where a name is defined.

    Raises:
        ValueError: it is not there.
    """
    module, wanted = package, name
    while True:
        if (path := find_file(f"{module}.{wanted}")) is not None:
            return Name(
                package, name, f"{module}.{wanted}", None, "module", read_module(path).summary
            )
        path = find_file(module)
        held = read_module(path) if path else None
        if held is not None and wanted in held.definitions:
            node = held.definitions[wanted]
            kind = "class" if isinstance(node, ast.ClassDef) else "function"
            return Name(package, name, module, node, kind, summary_of(node), wanted)
        if held is not None and wanted in held.constants:
            text = one_line(held.constants[wanted])
            return Name(package, name, module, None, "constant", text, wanted)
        if held is None or wanted not in held.imported:
            raise ValueError(f"{package}.{name} is listed in `__all__`, but not in {module}")
        module, inner = held.imported[wanted]
        wanted = inner or wanted


def listed(package: str) -> list[Name]:
    """The public names of a package, in alphabetical order.

    Raises:
        ValueError: the package lists what it does not have.
    """
    path = find_file(package)
    if path is None or not read_module(path).names:
        return []
    return [resolve(package, name) for name in sorted(read_module(path).names)]


def functions(package: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """(where it is defined, definition) of the public functions, those of listed modules too."""
    for name in listed(package):
        if isinstance(name.node, ast.FunctionDef):
            yield f"{name.home}.{name.node.name}", name.node
        elif name.kind == "module" and (path := find_file(name.home)) is not None:
            module = read_module(path)
            for inner in module.names:
                node = module.definitions.get(inner)
                if isinstance(node, ast.FunctionDef):
                    yield f"{module.name}.{inner}", node


def _cell(text: str) -> str:
    """Text that survives in a table cell."""
    return docstrings.to_markdown(text).replace("|", "\\|")


def page_of(package: str) -> str:
    """File name of a package's reference page."""
    return f"reference/{package.split('.')[-1]}.md"


def _by_task(names: list[Name]) -> dict[str, list[Name]]:
    order = list(dict.fromkeys(TASKS.values()))
    held: dict[str, list[Name]] = {}
    for name in sorted(names, key=lambda n: order.index(n.task) if n.task in order else len(order)):
        held.setdefault(name.task, []).append(name)
    return held


def _package_pages(package: str) -> tuple[list[str], list[str]]:
    """Lines of the list and of the reference page."""
    title = f"{PACKAGES[package]}: `{package}`"
    lines = ["", f"## {title}"]
    reference = [f"# {title}", "", "Back to the [list of public names](../api.md)."]
    for task, group in _by_task(listed(package)).items():
        lines += ["", f"### {task}", "", "| name | what it is |", "|---|---|"]
        reference += ["", f"## {task}"]
        for name in group:
            shown = signature(name.node) if name.node else name.name
            shown = shown.replace(f"{name.inner}(", f"{name.name}(", 1) if name.inner else shown
            link = f"[`{shown}`]({page_of(package)}#{name.path})"
            lines.append(f"| {link} | {_cell(name.text)} |")
            target = name.home if name.kind == "module" else f"{name.home}.{name.inner}"
            reference += ["", f'<a id="{name.path}"></a>', "", f"::: {target}"]
    return lines, reference


def render() -> dict[str, str]:
    """Path below docs/ -> text of each page."""
    lines = [HEAD.rstrip()]
    pages = {}
    for package in filter(listed, PACKAGES):
        more, reference = _package_pages(package)
        lines += more
        pages[page_of(package)] = "\n".join(reference) + "\n"
    lines += [TAIL.rstrip(), *(f"| `{module}` | {text} |" for module, text in BY_PATH.items())]
    return {"api.md": "\n".join(lines) + "\n", **pages}


def main(config: Config) -> dict[str, int]:
    """Write or check the pages; returns how many names they list."""
    docs = repository.ROOT / "docs"
    pages = render()
    for name, text in pages.items():
        path = docs / name
        if config.check and (not path.exists() or path.read_text(encoding="utf-8") != text):
            raise ValueError(f"{path} is out of date: run `python scripts/tools/render_api.py`")
        if not config.check:
            write_text(path, text)
    return {"names": sum(len(listed(p)) for p in PACKAGES), "pages": len(pages)}
