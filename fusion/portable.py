"""A fitted network as a program for processes without this package: StableHLO for jax, ONNX."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
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
    _check(fitted, batch, {"flatbuffers": "export"})
    shape = _shape(fitted, jax_export.symbolic_shape("b")[0] if batch is None else batch)
    made = jax_export.export(jax.jit(_program(fitted)), platforms=tuple(platforms))(shape)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(made.serialize())


def write_onnx(fitted: FittedARGate, path: str | Path, *, batch: int = 1) -> None:
    """Write a network with its parameters as an ONNX file, for runtimes without jax.

    Inputs and outputs are those of `write_program`; they agree to 1e-5.

    Args:
        fitted: of `fusion.finish`.
        path: of the file.
        batch: number of windows in a call; the converter cannot leave it open.

    Raises:
        ModuleNotFoundError: jax2onnx is missing.
        ValueError: a batch that is no number above 0.

    Example:
        >>> write_onnx(fitted, "activity.onnx")  # doctest: +SKIP
        >>> session = onnxruntime.InferenceSession("activity.onnx")  # doctest: +SKIP
        >>> name = session.get_inputs()[0].name  # doctest: +SKIP
        >>> probabilities, weights, failed = session.run(None, {name: window})  # doctest: +SKIP
    """
    _check(fitted, batch, {"jax2onnx": "onnx", "onnx": "onnx"})
    import onnx
    from jax2onnx import to_onnx

    model = to_onnx(_program(fitted), inputs=[_shape(fitted, batch).shape])
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(target))


def _check(fitted: FittedARGate, batch: int | None, needed: dict[str, str]) -> None:
    """Refuse what is no network, a missing library (-> its extra), and what is no batch."""
    check_type("fitted", fitted, FittedARGate, "make it with fusion.finish")
    for name, extra in needed.items():
        if importlib.util.find_spec(name) is None:
            raise ModuleNotFoundError(
                f"{name}: expected for programs; pip install 'snn-fusion-failure[{extra}]'"
            )
    if batch is None and fitted.config.head == "neighbourhood":
        raise ValueError(
            "batch=None: expected a number of windows for head='neighbourhood', whose work is "
            "split by it; give batch=1 for a stream"
        )
    if batch is not None:
        check_count("batch", batch)


def _shape(fitted: FittedARGate, batch: Any) -> jax.ShapeDtypeStruct:
    sizes = batch, fitted.config.n_sensors, fitted.config.n_times
    return jax.ShapeDtypeStruct(sizes, jnp.float32)


def _program(fitted: FittedARGate) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Raw windows to (class probabilities, fusion weights, failure probabilities)."""
    low, high = (
        jnp.asarray(v, jnp.float32)[None, :, None] for v in (fitted.scale.low, fitted.scale.high)
    )

    def program(x: Float[Array, "b k t"]) -> tuple[Array, Array, Array]:
        scaled = jnp.clip(2.0 * (x - low) / (high - low) - 1.0, -1.0, 1.0)
        # A window with one reading missing is absent as a whole.
        scaled = jnp.where(jnp.any(jnp.isnan(x), axis=-1, keepdims=True), jnp.nan, scaled)
        temperature = jnp.float32(fitted.temperature)
        return classify(fitted.config, fitted.params, fitted.monitor, temperature, scaled)

    return program
