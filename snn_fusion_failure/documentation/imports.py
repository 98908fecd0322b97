"""Who imports whom, read off the source files without importing them.

The tests of the structure and the picture of the architecture both come from here.
"""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

from snn_fusion_failure.runs import repository

ROOMS = ("jaxsnn", "fusion", "failure", "snn_fusion_failure", "scripts")
"""The top-level rooms, those that stand alone first."""


@dataclasses.dataclass(frozen=True)
class Graph:
    """The files of the rooms and their imports, those inside of functions too.

    Attributes:
        files: module name -> file; a package's name is that of its `__init__`.
        edges: module -> our modules that it imports.
        outside: module -> top-level names of other libraries that it imports.
    """

    files: Mapping[str, Path]
    edges: Mapping[str, frozenset[str]]
    outside: Mapping[str, frozenset[str]]

    def above(self, room: str) -> Iterator[tuple[str, str]]:
        """(importing module, imported module) for imports that leave a room."""
        for module, targets in self.edges.items():
            if module.split(".")[0] == room:
                yield from ((module, t) for t in sorted(targets) if t.split(".")[0] != room)

    def circles(self) -> list[tuple[str, ...]]:
        """Groups of files that reach each other by imports; empty when there is no circle."""
        reach = {module: self._reached(module) for module in self.edges}
        groups = {
            tuple(sorted({m, *(o for o in reach[m] if m in reach.get(o, ()))}))
            for m in reach
            if m in reach[m]
        }
        return sorted(groups)

    def _reached(self, start: str) -> frozenset[str]:
        found: set[str] = set()
        todo = list(self.edges[start])
        while todo:
            module = todo.pop()
            if module not in found:
                found.add(module)
                todo += self.edges.get(module, ())
        return frozenset(found)


def module_name(path: Path, root: Path = repository.ROOT) -> str:
    """`fusion/lattice/pwl.py` is `fusion.lattice.pwl`; an `__init__` has its package's name."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _targets(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """(module, name taken from it or '') of every import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"line {node.lineno}: relative import; write the whole name")
            yield from ((node.module or "", alias.name) for alias in node.names)


def read(root: Path = repository.ROOT, rooms: tuple[str, ...] = ROOMS) -> Graph:
    """The imports of all files of the rooms.

    Raises:
        ValueError: a file uses a relative import.
    """
    files = {module_name(p, root): p for room in rooms for p in sorted((root / room).rglob("*.py"))}
    edges: dict[str, frozenset[str]] = {}
    outside: dict[str, frozenset[str]] = {}
    for module, path in files.items():
        ours, others = set(), set()
        for base, name in _targets(ast.parse(path.read_text(encoding="utf-8"))):
            if base.split(".")[0] not in rooms:
                others.add(base.split(".")[0])
            elif f"{base}.{name}" in files:
                ours.add(f"{base}.{name}")
            else:
                ours.add(base)
        edges[module] = frozenset(ours - {module})
        outside[module] = frozenset(others)
    return Graph(files, edges, outside)
