"""What a simulator is called, in run folders and in caches of results."""

from __future__ import annotations

import dataclasses
import hashlib
from functools import partial
from typing import Any

import numpy as np


def _own_identity(simulate: Any) -> str:
    """The identity that a simulator gives itself, "" where it has none."""
    for holder in (simulate, getattr(simulate, "_batch", None)):
        own = getattr(holder, "identity", None)
        if isinstance(own, str) and own:
            return own
    return ""


def _told(value: Any) -> str:
    """An argument in an identity: the same text in every process, another one for another value."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_told(k)}: {_told(v)}' for k, v in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_told(part) for part in value)}]"
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and not callable(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return f"{type(value).__qualname__}({_told(fields)})"
    if isinstance(value, set | frozenset):
        return f"set {sorted(_told(part) for part in value)}"
    if hasattr(value, "dtype") and hasattr(value, "shape") and np.ndim(value):
        data = np.asarray(value)
        digest = hashlib.sha256(np.ascontiguousarray(data).tobytes()).hexdigest()[:12]
        return f"{data.dtype}{list(data.shape)} {digest}"
    if callable(value) or type(value).__repr__ is object.__repr__:
        # Its own text would hold an address, which no second process has.
        return identity_of(value)
    return repr(value.item() if hasattr(value, "item") else value)


def identity_of(simulate: Any) -> str:
    """What a simulator is called in a run folder and in a cache.

    Its `identity` where it has one; a circuit's name; of a `functools.partial` its function and
    arguments; else module and name of the function or of the class. Give `run(..., identity=...)`
    where that says too little, as for a closure.

    Example:
        >>> identity_of(identity_of)
        'failure.identities.identity_of'
        >>> from functools import partial
        >>> identity_of(partial(identity_of, corner="hot"))
        "failure.identities.identity_of(corner='hot')"
    """
    own = _own_identity(simulate)
    if own:
        return own
    if isinstance(simulate, partial):
        given = [_told(value) for value in simulate.args]
        given += [f"{name}={_told(simulate.keywords[name])}" for name in sorted(simulate.keywords)]
        return f"{identity_of(simulate.func)}({', '.join(given)})"
    owner = getattr(simulate, "__self__", None)
    if _own_identity(owner):
        return f"{_own_identity(owner)}.{simulate.__name__}"
    name = getattr(owner, "name", None)
    if isinstance(name, str) and name:
        return f"{type(owner).__name__} {name}"
    named = simulate if hasattr(simulate, "__qualname__") else type(simulate)
    return f"{named.__module__}.{named.__qualname__}"
