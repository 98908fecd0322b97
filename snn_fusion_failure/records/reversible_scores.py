"""Scores of a trained network of the study of reversible fusion: both kinds of paths, cost."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from snn_fusion_failure.records import gate_scores
from snn_fusion_failure.records.fusion_tables import UNSEEN_KINDS
from snn_fusion_failure.records.reversible_parts import training_memory


@functools.lru_cache(maxsize=32)
def memory_of(model: Any) -> float:
    """Memory of training a network [MB], compiled once for all seeds."""
    from fusion.config import HyperParams

    return training_memory(model, HyperParams())


def scored(
    model: Any, state: Any, dataset: Any, noise: Any, kind: str, *, key: Any
) -> dict[str, Any]:
    """Scores of the class probabilities and of the fusion weights under one kind of failure."""
    import jax

    from fusion import evaluate
    from fusion.loop import test_output
    from fusion.models import export

    out = test_output(model, state, dataset, noise, key=key, kind=kind)
    p, weights = np.asarray(jax.nn.softmax(out.logits, axis=-1)), out.weights
    if model.variational:
        x, _ = gate_scores.corrupted(
            dataset.test_x, noise.test, kind, key=jax.random.fold_in(key, 3)
        )
        drawn = functools.partial(_draws(model), export(state.params))
        p, weights = gate_scores.in_chunks(drawn, x)
    found: dict[str, Any] = gate_scores.class_scores(p, out.labels)
    split = evaluate.split_accuracy(out.labels, p.argmax(-1), out.failed)
    found["accuracy_clean"], found["accuracy_corrupted"] = 100 * split.clean, 100 * split.corrupted
    if model.recipe.gate != "none" and out.failed.any():
        found["failed_auroc"] = gate_scores.auroc_of(-weights, out.failed)
    return found


@functools.lru_cache(maxsize=32)
def _auxiliary_logits(model: Any) -> Any:
    import jax

    from fusion.models import auxiliary_logits, export, predict

    def logits(params: Any, x: Any, failed: Any) -> Any:
        told = failed if model.reads_failed else None
        features = predict(model, export(params), x, told).features
        return auxiliary_logits(model, params, x, features)

    return jax.jit(logits)


@functools.lru_cache(maxsize=32)
def _draws(model: Any) -> Any:
    import jax

    from fusion.uncertainty import sample_predictive

    return functools.partial(jax.jit(sample_predictive, static_argnums=0), model)


def auxiliary(model: Any, params: Any, x: Any, failed: Any, y: np.ndarray) -> dict[str, float]:
    """Loss and accuracy % of the auxiliary paths of working sensors."""
    import jax

    from fusion.losses import cross_entropy

    logits_of = _auxiliary_logits(model)
    places = [slice(i, i + 512) for i in range(0, len(x), 512)]
    parts = [logits_of(params, x[place], failed[place]) for place in places]
    logits = np.concatenate([np.asarray(part) for part in parts])
    told = np.broadcast_to(y[:, None], logits.shape[:2])
    works = ~np.asarray(failed)
    losses = np.asarray(cross_entropy(jax.numpy.asarray(logits), jax.numpy.asarray(told)))
    right = logits.argmax(-1) == told
    return {"aux_loss": float(losses[works].mean()), "aux_accuracy": 100 * right[works].mean()}


def trained_scores(
    settings: Any, dataset: Any, noise: Any, seed: int, *, unseen: bool
) -> dict[str, Any]:
    """Train one network; its scores, its cost, and means under unseen kinds if asked."""
    import jax

    from fusion.loop import fit
    from fusion.models import export
    from fusion.sizes import count_parameters
    from fusion.spiking.operations import cost

    key, model = jax.random.key(seed), settings.model
    parts = settings.model, settings.train, settings.hyper
    state = fit(*parts, dataset, noise, key=key).state
    record = scored(model, state, dataset, noise, noise.kind, key=key)
    if model.recipe.loss.auxiliary:
        x, failed = gate_scores.corrupted(
            dataset.test_x, noise.test, noise.kind, key=jax.random.fold_in(key, 3)
        )
        record |= auxiliary(model, state.params, x, failed, dataset.test_y)
    price = cost(model, export(state.params), dataset.test_x[:512])._asdict()
    record |= {name: price[name] for name in ("multiply_adds", "synaptic_operations")}
    record |= {"parameters": count_parameters(model)["main"], "training_memory": memory_of(model)}
    if unseen:
        each = [scored(model, state, dataset, noise, kind, key=key) for kind in UNSEEN_KINDS]
        record["unseen"] = {m: float(np.mean([one[m] for one in each])) for m in each[0]}
    return record
