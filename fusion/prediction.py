"""The exported main model on many examples, in chunks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion._checks import check_count, check_mask
from fusion._inputs import check_windows
from fusion.config import ModelConfig
from fusion.models import Params, predict


def predict_batches(
    model: ModelConfig,
    main: Params,
    x: Float[Array, "n k t"],
    failed: Bool[Array, "n k"] | None = None,
    *,
    batch_size: int = 256,
) -> tuple[Float[Array, "n c"], Float[Array, "n k"]]:
    """Logits and fusion weights of many examples, by the exported main model, in chunks.

    Args:
        model: static.
        main: `fusion.models.export(params)`; no auxiliary parameter is read.
        x: windows.
        failed: mask of failed sensors, for the oracle gate only, which needs it.
        batch_size: examples per chunk; bounds the memory.

    Returns:
        (logits `[n, class]`, fusion weights `[n, sensor]`).

    Raises:
        ValueError: `failed` for a model that does not read it, or an oracle without it; what
            `fusion.predict` refuses.
    """
    check_count("batch_size", batch_size)
    n = x.shape[0]
    check_windows(model, x)
    if failed is not None:
        check_mask("failed", failed, x.shape[:2])
    # A neighbourhood head splits the work itself, and reads its memory once for all examples.
    batch_size = n if model.head == "neighbourhood" else min(batch_size, n)
    n_chunks = -(-n // batch_size)
    padding = n_chunks * batch_size - n

    def chunked(a: Array) -> Array:
        padded = jnp.concatenate([a, jnp.zeros((padding, *a.shape[1:]), a.dtype)])
        return padded.reshape(n_chunks, batch_size, *a.shape[1:])

    def chunk(inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        out = predict(model, main, *inputs)
        return out.logits, out.weights

    given = (x,) if failed is None else (x, failed)
    logits, weights = jax.lax.map(chunk, tuple(map(chunked, given)))
    return logits.reshape(-1, model.n_classes)[:n], weights.reshape(-1, model.n_sensors)[:n]
