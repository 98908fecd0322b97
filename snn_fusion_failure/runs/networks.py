"""A preset of the spiking networks with constants changed on the command line."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Sequence
from typing import Any

from snn_fusion_failure.runs.changes import apply_changes

# Short names of the parts of the parameters that have their own.
_INSIDE = {"stdp": "params.stdp", "reward": "params.reward"}


def changed_preset(model: str, reading: str, changes: Sequence[str]) -> tuple[Any, Any]:
    """`jaxsnn.presets.preset` with `--set` applied to it.

    Args:
        model: "S1" to "S4".
        reading: "tuned" or "literal".
        changes: `config.bounds=soft`, `params.gamma=5e-4`, `stdp.tau_z=0.05`, `reward.k=0.8`.

    Returns:
        NetworkConfig and NetworkParams. What follows from a changed choice follows it: the
        additive rule has its own `k`, whichever model it is set on.

    Raises:
        ValueError: a change is not of that form, or the network would not run with it.

    Example:
        >>> _, params = changed_preset("S4", "tuned", ["stdp.tau_z=0.05"])
        >>> params.stdp.tau_z
        0.05
    """
    from jaxsnn.config import check_network
    from jaxsnn.presets import preset

    config, params = preset(model, reading)
    changes = [_full(change) for change in changes]
    first = [c for c in changes if c.startswith("config.")]
    # Sizes that depend on one another are checked when all of them are changed, not in between.
    names = [f.name for f in dataclasses.fields(config)]
    unchecked = collections.namedtuple("unchecked", names)(*(getattr(config, n) for n in names))
    changed = apply_changes({"config": unchecked, "params": params}, first)["config"]._asdict()
    different = {n: v for n, v in changed.items() if v != getattr(config, n)}
    config, params = preset(model, reading, config=different)
    rest = [c for c in changes if not c.startswith("config.")]
    params = apply_changes({"config": config, "params": params}, rest)["params"]
    check_network(config, params)
    return config, params


def _full(change: str) -> str:
    part, dot, rest = change.partition(".")
    return f"{_INSIDE.get(part, part)}{dot}{rest}"
