"""Where a study's function is, and a fingerprint of everything that its numbers depend on.

The fingerprint covers the source of the study and of all modules that it imports from the same
place or from this project, without comments and docstrings, and the versions of the libraries. A
chunk carries it, so that numbers of changed code are never mixed with older ones unseen.
"""

from __future__ import annotations

import ast
import copy
import functools
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.origin import versions
from snn_fusion_failure.runs.repository import ROOT

_OURS = ("jaxsnn", "fusion", "failure", "snn_fusion_failure")


def find_function(
    name: str, *, known: Iterable[str] = (), where: str | None = None
) -> Callable[..., Any]:
    """The function that `module:function` or `file.py:function` names.

    The current directory is searched after what is installed. A module of one's own that an
    installed one hides is refused rather than replaced by it.

    Args:
        name: where the function is.
        known: names to list when this one cannot be read.
        where: a further folder to search, in which it was found before.

    Raises:
        ValueError: nothing of that name can be imported.
    """
    module, colon, attribute = name.rpartition(":")
    if not colon or not module:
        raise ValueError(f"study={name!r}: expected one of {', '.join(known)}, or module:function")
    for place in (where, os.getcwd()):
        if place and place not in sys.path:
            sys.path.append(place)
    try:
        loaded = _load_file(module) if module.endswith(".py") else importlib.import_module(module)
        _refuse_hidden(name, module, getattr(loaded, "__file__", None))
        found: Any = loaded
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, OSError, SyntaxError) as error:
        raise ValueError(
            f"study={name!r}: expected a function that can be imported; {error}"
        ) from error
    if not callable(found):
        raise ValueError(f"study={name!r}: expected a function; got {type(found).__name__}")
    return found


def _refuse_hidden(name: str, module: str, used: str | None) -> None:
    """Refuse an installed module where this directory has one of the same name."""
    own = Path(os.getcwd(), *module.split(".")).with_suffix(".py")
    if not module.endswith(".py") and own.is_file() and used and not own.samefile(used):
        raise ValueError(
            f"study={name!r}: expected {own.name} of this directory, but {used} has the same "
            "name; rename yours"
        )


def _load_file(text: str) -> Any:
    path = Path(text).resolve()
    main = sys.modules.get("__main__")
    if main is not None and Path(getattr(main, "__file__", None) or "-").resolve() == path:
        return main
    name = f"study_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def folder_of(function: Any) -> str | None:
    """The folder from which a module of one's own is imported; None for installed ones."""
    module = sys.modules.get(getattr(function, "__module__", ""))
    file = getattr(module, "__file__", None)
    if module is None or file is None or _top(module.__name__) in _OURS:
        return None
    depth = module.__name__.count(".") + (Path(file).name == "__init__.py")
    folder = Path(file).resolve().parents[depth]
    return None if "site-packages" in folder.parts else str(folder)


def _top(name: str) -> str:
    return name.partition(".")[0]


def _without_text(tree: ast.AST) -> str:
    """Source as a tree: layout, comments and docstrings do not change numbers."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        if isinstance(node, kinds) and body:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = body[1:]
    return ast.dump(tree)


def _imported(tree: ast.AST, module: str, is_package: bool) -> set[str]:
    """Names of modules that a file may import, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                up = node.level - is_package
                parts = parts[: len(parts) - up] if up else parts
                base = ".".join([*parts, *([node.module] if node.module else [])])
            if base:
                found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    # A package's own file runs whenever one of its modules is imported.
    for name in list(found):
        parts = name.split(".")
        found |= {".".join(parts[:i]) for i in range(1, len(parts))}
    return found


@functools.lru_cache(maxsize=4096)
def _read(path: str, stamp: tuple[int, int]) -> ast.AST:
    return ast.parse(Path(path).read_bytes())


def _parse(path: Path) -> ast.AST:
    stat = path.stat()
    return _read(str(path), (stat.st_mtime_ns, stat.st_size))


def _file_of(name: str, own: Path | None, own_top: str | None) -> Path | None:
    roots = [ROOT] if _top(name) in _OURS else []
    if own is not None and (own_top is None or _top(name) == own_top):
        roots.append(own)
    for root in roots:
        path = root.joinpath(*name.split("."))
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.is_file():
                return file
    return None


def sources(function: Any) -> dict[str, str]:
    """Hash of the source of a study's function and of each module it may use, by module name."""
    name = getattr(function, "__module__", None) or "__main__"
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if not file or not Path(file).is_file():
        try:
            text = inspect.getsource(function)
        except (OSError, TypeError):
            code = getattr(function, "__code__", None)
            text = repr((code.co_code, code.co_consts) if code else function)
        return {name: hashlib.sha256(text.encode()).hexdigest()[:16]}
    start = Path(file).resolve()
    depth = name.count(".") + (start.name == "__init__.py")
    own, own_top = start.parents[depth], None
    if "site-packages" in start.parts or (_top(name) not in _OURS and depth):
        own_top = _top(name)  # of an installed or larger package only its own modules
    if depth == 0:
        name = start.stem  # the same whether it runs as a script or is loaded by a worker
    found: dict[str, str] = {}
    waiting: list[tuple[str, Path]] = [(name, start)]
    while waiting:
        at, path = waiting.pop()
        if at in found:
            continue
        tree = _parse(path)
        imported = _imported(tree, at, path.name == "__init__.py")
        text = _without_text(copy.deepcopy(tree))
        found[at] = hashlib.sha256(text.encode()).hexdigest()[:16]
        for other in sorted(imported - set(found)):
            where = _file_of(other, own, own_top)
            # The engine deals out work; what a trial computes does not depend on it.
            if where is not None and not _is_engine(other):
                waiting.append((other, where))
    return dict(sorted(found.items()))


def _is_engine(name: str) -> bool:
    rooms = [f"snn_fusion_failure.{room}" for room in ("sweeps", "runs", "records")]
    if name == "snn_fusion_failure" or name.startswith("snn_fusion_failure.sweeps.studies."):
        return name == "snn_fusion_failure"
    return name.startswith(tuple(rooms))


def fingerprint(function: Any) -> dict[str, Any]:
    """`id` of all that numbers depend on, and what it was made from: `sources`, `versions`."""
    found = sources(function)
    used = versions()
    data = repr((sorted(found.items()), sorted(used.items())))
    return {"id": hashlib.sha256(data.encode()).hexdigest()[:16], "sources": found,
            "versions": used}  # fmt: skip


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """What differs between two fingerprints, in words."""
    parts = []
    for kind, verb in (("sources", "changed"), ("versions", "changed version")):
        before, after = old.get(kind, {}), new.get(kind, {})
        names = sorted(k for k in {*before, *after} if before.get(k) != after.get(k))
        if names:
            few = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
            parts.append(f"{few} {verb}")
    return "; ".join(parts) or "nothing that is listed changed"
