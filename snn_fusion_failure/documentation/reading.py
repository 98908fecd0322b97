"""Modules and their definitions, read off the source files without importing them."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from snn_fusion_failure.documentation import imports
from snn_fusion_failure.runs import repository

Definition = ast.FunctionDef | ast.ClassDef


@dataclasses.dataclass(frozen=True)
class Module:
    """A module without a leading underscore in its path.

    Attributes:
        name: dotted.
        summary: first paragraph of its docstring.
        names: its `__all__`, or what it defines without a leading underscore.
        definitions: functions and classes.
        imported: name here -> (module, name there or '').
        constants: assigned name -> docstring below it, '' without one.
    """

    name: str
    path: Path
    summary: str
    names: tuple[str, ...]
    definitions: Mapping[str, Definition]
    imported: Mapping[str, tuple[str, str]]
    constants: Mapping[str, str]


def one_line(text: str) -> str:
    """The first paragraph of a docstring on one line."""
    return " ".join(text.split("\n\n")[0].split())


def summary_of(node: ast.AST) -> str:
    """The first paragraph of a docstring on one line, or ''."""
    return one_line(ast.get_docstring(node) or "")  # type: ignore[arg-type]


def _constants(body: list[ast.stmt]) -> Iterator[tuple[str, str, ast.expr | None]]:
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.Assign | ast.AnnAssign):
            text = ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                text = str(after.value.value)
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Name):
                    yield target.id, text, node.value


def read_module(path: Path) -> Module:
    """What a file defines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    definitions = {node.name: node for node in tree.body if isinstance(node, Definition)}
    imported: dict[str, tuple[str, str]] = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            imported |= {a.asname or a.name: (node.module or "", a.name) for a in node.names}
        elif isinstance(node, ast.Import):
            imported |= {a.asname or a.name: (a.name, "") for a in node.names}
    constants = {}
    names = None
    for name, text, value in _constants(tree.body):
        if name == "__all__" and value is not None:
            names = tuple(ast.literal_eval(value))
        else:
            constants[name] = text
    if names is None:
        names = tuple(n for n in (*definitions, *constants) if not n.startswith("_"))
    return Module(
        imports.module_name(path), path, summary_of(tree), names, definitions, imported, constants
    )


def public_modules(package: str) -> Iterator[Module]:
    """The modules of a package whose path has no leading underscore, in alphabetical order."""
    for path in sorted((repository.ROOT / package).rglob("*.py")):
        parts = path.relative_to(repository.ROOT).with_suffix("").parts
        if not any(part.startswith("_") and part != "__init__" for part in parts):
            yield read_module(path)


def find_file(module: str) -> Path | None:
    """The file of a dotted name; None where there is none."""
    base = repository.ROOT.joinpath(*module.split("."))
    path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    return path if path.exists() else None


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


def is_function_of_arrays(node: ast.AST) -> bool:
    """A function with jax arrays (more than one key) in its signature."""
    if not isinstance(node, ast.FunctionDef):
        return False
    result = ast.unparse(node.returns) if node.returns else ""
    text = re.sub(r"Key\[Array, ['\"]{2}\]", "", f"{ast.unparse(node.args)} -> {result}")
    return bool(re.search(r"\bArray\b", text))
