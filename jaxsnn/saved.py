"""Trained networks in a file, to be tested or to go on with on another map.

Kept are weights, running means of the firing, the number of steps in which the network has learnt
and its critic; membranes and traces start anew with every trial.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsnn import network
from jaxsnn.config import NetworkConfig, NetworkParams
from jaxsnn.network import NetworkState

KEPT = ("weights", "baseline_input", "baseline_hidden", "updates", "critic")


def save_networks(path: str | Path, config: NetworkConfig, states: NetworkState) -> Path:
    """Write networks `[robots, ...]` and their configuration into one `.npz` file.

    Raises:
        ValueError: the name does not end in `.npz`.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"save={path}: expected a name that ends in .npz; rename it")
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = tuple(getattr(states, name) for name in KEPT)
    arrays: dict[str, Any] = {
        f"leaf_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(kept))
    }
    text = json.dumps(dataclasses.asdict(config))
    with path.open("wb") as file:
        np.savez(file, config=np.asarray(text), **arrays)
    return path


def load_networks(path: str | Path, config: NetworkConfig, params: NetworkParams) -> NetworkState:
    """Networks `[robots, ...]` of a file, at rest.

    Args:
        path: file of `save_networks`.
        config: NetworkConfig; sizes and codes must be those that the networks were trained with.
        params: NetworkParams; the weights must lie inside its bounds.

    Raises:
        ValueError: the file is missing or not one of ours, or the networks do not fit.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = json.loads(str(file["config"]))
            leaves = [jnp.asarray(file[f"leaf_{i}"]) for i in range(len(file.files) - 1)]
    except (OSError, KeyError, ValueError, EOFError) as error:
        raise ValueError(
            f"from={path}: expected a file written by --save, {error}; check the path"
        ) from error
    given = dataclasses.asdict(config)
    sizes = ("hidden_exc", "hidden_inh", "group_exc", "group_inh", "input_code", "turn_groups",
             "encoding", "angle_code", "critic", "n_sonars")  # fmt: skip
    for name in sizes:
        # A file from before there was such a choice has its default.
        if stored.get(name, getattr(NetworkConfig, name)) != given[name]:
            raise ValueError(
                f"from={path}: expected networks with {name}={given[name]!r}, they have "
                f"{stored.get(name)!r}; use the model and the changes that they were trained with"
            )
    one = network.init(jax.random.key(0), config, params)
    shape = jax.tree.structure(tuple(getattr(one, name) for name in KEPT))
    kept = dict(zip(KEPT, jax.tree.unflatten(shape, leaves), strict=True))
    robots = len(kept["updates"])
    network.check_weights(config, params, kept["weights"], robots)
    state = jax.tree.map(lambda x: jnp.broadcast_to(x, (robots, *x.shape)), one)
    return state._replace(**kept)
