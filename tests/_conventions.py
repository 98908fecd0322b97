"""Reads conventions off the source: order of arguments, keys, plots, backticks."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from snn_fusion_failure.documentation import imports

PACKAGES = ("jaxsnn", "fusion", "failure", "snn_fusion_failure")
ROLES = ("config", "params", "state", "inputs")
"""The order of positional arguments."""


def sources(*rooms: str) -> Iterator[tuple[str, Path, ast.Module]]:
    """(module, file, syntax tree) of all files of the rooms."""
    for module, path in imports.read(rooms=rooms).files.items():
        yield module, path, ast.parse(path.read_text(encoding="utf-8"))


def public_functions(*rooms: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """(module.function, definition) without a leading underscore anywhere in the name."""
    for module, _, tree in sources(*rooms):
        if any(part.startswith("_") for part in module.split(".")):
            continue
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                yield f"{module}.{node.name}", node


def role(argument: ast.arg) -> str | None:
    """What an argument is, by its name or by the class that it is annotated with."""
    if argument.arg in ("key", "keys"):
        return None
    text = ast.unparse(argument.annotation) if argument.annotation else ""
    # Containers of the house are annotated bare; `Callable[...]` or `dict[...]` of them is another.
    kind = text.split("|")[0].strip().split(".")[-1] if "[" not in text else ""
    for name in ROLES[:3]:
        if argument.arg == name or kind.endswith(name.capitalize()):
            return name
    if re.search(r"\b(Float|Int|Bool|Num|Shaped|UInt8)\[Array|^Array\b", text):
        return "inputs"
    return None


def is_init(name: str) -> bool:
    """`init`, `init_network`, `lif_init`: these start with the key, where they have one."""
    return name == "init" or name.startswith("init_") or name.endswith("_init")


def argument_faults(node: ast.FunctionDef) -> list[str]:
    """What is not as it should be: `config, params, state, inputs, *, key`."""
    faults = []
    positional = [*node.args.posonlyargs, *node.args.args]
    required = positional[: len(positional) - len(node.args.defaults)]
    names = [a.arg for a in positional]
    if "key" in names and not (is_init(node.name) and names[0] == "key"):
        faults.append("key is not keyword-only")
    order = [ROLES.index(r) for a in required if (r := role(a)) is not None]
    if order != sorted(order):
        faults.append(f"order of ({', '.join(a.arg for a in required)})")
    return faults


def double_backticks(path: Path) -> list[int]:
    """Lines of a source file with a double backtick in a docstring or a comment."""
    return [
        number
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        # A string that holds nothing else is code that looks for them.
        if re.search(r"(?<![`\"'])``(?![`\"'])", line)
    ]
