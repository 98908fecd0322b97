"""A fitted network as a StableHLO program, for processes that have jax but not this package."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export as jax_export
from jaxtyping import Array, Float

from fusion._checks import check_count, check_type
from fusion.fitted import FittedARGate, classify


def write_program(
    fitted: FittedARGate, path: str | Path, *, batch: int | None = None, platforms: Any = ("cpu",)
) -> None:
    """Write a network with its parameters as one file that `jax.export.deserialize` reads.

    The program takes raw windows `[batch, sensor, time]` float32, NaN for what is absent, and gives
    (class probabilities, fusion weights, failure probabilities), as `FittedARGate.predict` does.

    Args:
        fitted: of `fusion.finish`.
        path: of the file.
        batch: number of windows in a call; any number when left out.
        platforms: where the program is to run, such as `("cpu", "cuda")`.

    Raises:
        ModuleNotFoundError: flatbuffers is missing, which jax writes programs with.
        ValueError: a neighbourhood head without `batch`, since its work is split by it.

    Example:
        >>> write_program(fitted, "activity.stablehlo")  # doctest: +SKIP
        >>> data = Path("activity.stablehlo").read_bytes()  # doctest: +SKIP
        >>> program = jax.export.deserialize(data)  # doctest: +SKIP
        >>> probabilities, weights, failed = program.call(windows)  # doctest: +SKIP
    """
    check_type("fitted", fitted, FittedARGate, "make it with fusion.finish")
    if importlib.util.find_spec("flatbuffers") is None:
        raise ModuleNotFoundError(
            "flatbuffers: expected for programs of jax.export; "
            "pip install 'snn-fusion-failure[export]'"
        )
    config = fitted.config
    if batch is None and config.head == "neighbourhood":
        raise ValueError(
            "batch=None: expected a number of windows for head='neighbourhood', whose work is "
            "split by it; give batch=1 for a stream"
        )
    if batch is not None:
        check_count("batch", batch)
    low, high = (
        jnp.asarray(v, jnp.float32)[None, :, None] for v in (fitted.scale.low, fitted.scale.high)
    )

    def program(x: Float[Array, "b k t"]) -> tuple[Array, Array, Array]:
        scaled = jnp.clip(2.0 * (x - low) / (high - low) - 1.0, -1.0, 1.0)
        # A window with one reading missing is absent as a whole.
        scaled = jnp.where(jnp.any(jnp.isnan(x), axis=-1, keepdims=True), jnp.nan, scaled)
        temperature = jnp.float32(fitted.temperature)
        return classify(config, fitted.params, fitted.monitor, temperature, scaled)

    (size,) = (batch,) if batch is not None else jax_export.symbolic_shape("b")
    shape = jax.ShapeDtypeStruct((size, config.n_sensors, config.n_times), jnp.float32)
    made = jax_export.export(jax.jit(program), platforms=tuple(platforms))(shape)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(made.serialize())
