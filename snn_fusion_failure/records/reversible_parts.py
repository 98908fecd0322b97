"""What reversibility is for, measured: memory of training, and failed sensors restored."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

BATCH = 64
TEST_ROWS = 1000
LEVEL = 0.9
"""Share of the samples that an interval should hold."""
COMPONENTS, BNN_ROWS = 64, 1500
"""Principal components and rows that the Bayesian network reads; it has no batches."""


def training_memory(model: Any, hyper: Any, batch: int = BATCH) -> float:
    """Temporary memory of a compiled gradient of the training loss [MB]."""
    from fusion.models import init
    from fusion.train import batch_loss

    def loss(params: Any, x: Any, y: Any, failed: Any) -> Any:
        return batch_loss(model, hyper, params, x, y, failed, key=jax.random.key(0))[0]

    shape = batch, model.n_sensors
    windows = jax.ShapeDtypeStruct((*shape, model.n_times), jnp.float32)
    labels = jax.ShapeDtypeStruct(shape[:1], jnp.int32)
    failed = jax.ShapeDtypeStruct(shape, bool)
    params = jax.eval_shape(lambda: init(jax.random.key(0), model))
    compiled = jax.jit(jax.grad(loss)).lower(params, windows, labels, failed).compile()
    found: Any = compiled.memory_analysis()
    return float(found.temp_size_in_bytes) / 1e6


def with_trunk(model: Any, **changes: Any) -> Any:
    """A network with changed stages of its reversible encoders."""
    trunk = dataclasses.replace(model.encoder.reversible, **changes)
    encoder = dataclasses.replace(model.encoder, reversible=trunk)
    return dataclasses.replace(model, encoder=encoder)


def memory_by_depth(
    model: Any, hyper: Any, x: np.ndarray, depths: tuple[int, ...]
) -> list[dict[str, Any]]:
    """Memory of training with `depth` blocks, with and without the reverse rule.

    Args:
        model: a network with reversible encoders.
        hyper: of its training.
        x: windows of one batch; gradients of their summed features are compared.
        depths: multiples of the number of stages.
    """
    from fusion.reversible import blocks

    stages, rows = len(model.encoder.reversible.squeezes), []
    windows = jnp.transpose(jnp.asarray(x), (1, 0, 2))[..., None]
    for depth in depths:
        slopes = {}
        for name, recompute in (("recomputed", True), ("stored", False)):
            deep = with_trunk(model, depths=(depth // stages,) * stages, recompute=recompute)
            memory = training_memory(deep, hyper, len(x))
            cell = {"row": f"depth {depth}", "model": name, "metric": "memory_by_depth"}
            rows.append(cell | {"unit": "MB", "value": memory})
            trunk = deep.encoder.reversible
            params = blocks.init(jax.random.key(0), trunk, windows.shape[0])
            slope = jax.jit(
                jax.grad(lambda p, c=trunk: jnp.mean(jax.nn.relu(blocks.forward(c, p, windows))))
            )(params)
            slopes[name] = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(slope)])
        apart = np.abs(slopes["recomputed"] - slopes["stored"]).max()
        largest = np.abs(slopes["stored"]).max()
        cell = {"row": f"depth {depth}", "model": "recomputed", "metric": "gradient_difference"}
        rows.append(cell | {"unit": "1", "value": float(apart / largest)})
    return rows


def without(rows: Any, sensor: int) -> Any:
    """All sensors' rows but one's, side by side."""
    return jnp.delete(rows, sensor, axis=1).reshape(len(rows), -1)


def nearest(train: Any, test: Any, sensor: int) -> Any:
    """The sensor's window in the training example whose other windows are nearest."""
    a, b = without(train, sensor), without(test, sensor)
    apart = jnp.sum(a**2, axis=1)[None] - 2.0 * b @ a.T
    return train[jnp.argmin(apart, axis=1), sensor]


def by_network(inputs: Any, outputs: Any, new: Any, *, key: Any) -> Any:
    """Means of the Bayesian network of chapter 4, on principal components of the inputs."""
    from failure import bnn

    chosen = jax.random.permutation(key, len(inputs))[:BNN_ROWS]
    shift = jnp.mean(inputs, axis=0)
    centred = inputs[chosen] - shift[None]
    values, vectors = jnp.linalg.eigh(centred @ centred.T)
    axes = centred.T @ vectors[:, -COMPONENTS:] / jnp.sqrt(values[None, -COMPONENTS:])
    config, training = bnn.BNNConfig(hidden=64, steps=600), bnn.BNNTrainParams()
    fitted, _ = bnn.fit(config, training, centred @ axes, outputs[chosen], key=key)
    return bnn.predict(fitted, (new - shift[None]) @ axes)


def restorations(
    config: Any, main: Any, drawn: Any, train: Any, held: Any, test: Any, sensor: int, *, key: Any
) -> dict[str, tuple[Any, Any]]:
    """Method -> restored windows of a sensor, and its interval or None.

    Args:
        config: of the trunks; main, drawn: parameters of trained encoders and of untrained ones.
        train, held, test: clean windows; `held` of people that `train` has not.
        sensor: the one that failed.
        key: of draws.
    """
    from fusion.reversible import restoration as r

    own = train[:, sensor]
    found: dict[str, tuple[Any, Any]] = {
        "zeros": (jnp.zeros_like(test[:, sensor]), None),
        "training mean": (jnp.broadcast_to(jnp.mean(own, 0), test[:, sensor].shape), None),
        "nearest neighbour": (nearest(train, test, sensor), None),
    }
    # A line between windows, the same density in their own coordinates.
    plain = r.fit_restoration(without(train, sensor), own)
    plain = r.spread_of_others(plain, without(held, sensor), held[:, sensor])
    found["line on windows"] = _drawn(plain, without(test, sensor), key=key)
    found["line fitted on the same people too (bound)"] = _crossed(train, test, sensor), None
    for trunk, params in (("", main), (", trunk as drawn", drawn)):
        rows, seen, new = (r.trunk_rows(config, params, x) for x in (train, held, test))
        asked, target = without(new, sensor), rows[:, sensor]
        fit = r.fit_restoration(without(rows, sensor), target)
        spreads = {"": r.spread_of_others(fit, without(seen, sensor), seen[:, sensor])}
        if not trunk:
            spreads[", spread of training rows"] = fit
            zero = jnp.zeros_like(new[:, sensor])
            network = by_network(without(rows, sensor), target, asked, key=key)
            for name, outputs in (
                ("zero features", zero),
                ("Bayesian network on features", network),
                ("Bayesian line on features, without draws", r.restored_rows(fit, asked)[0]),
                ("its own features", new[:, sensor]),
            ):
                found[name] = r.rows_to_windows(config, params, outputs, sensor), None
            # No inverse: are the others' features to blame, or the coordinates of its own?
            straight = r.fit_restoration(without(rows, sensor), own)
            found["Bayesian line from features to windows"] = (
                r.restored_rows(straight, asked)[0],
                None,
            )
        for spread, of in spreads.items():
            back = r.restore_windows(config, params, of, asked, sensor, key=key, level=LEVEL)
            found[f"Bayesian line on features{trunk}{spread}"] = back.mean, (back.low, back.high)
    return found


def _crossed(train: Any, test: Any, sensor: int) -> Any:
    """A line between windows, told by training rows and one half of the test for the other half."""
    from fusion.reversible import restoration as r

    half = len(test) // 2
    found = []
    for told, asked in ((test[half:], test[:half]), (test[:half], test[half:])):
        rows = jnp.concatenate([train, told])
        fit = r.fit_restoration(without(rows, sensor), rows[:, sensor])
        found.append(r.restored_rows(fit, without(asked, sensor))[0])
    return jnp.concatenate(found)


def _drawn(fit: Any, inputs: Any, *, key: Any) -> tuple[Any, Any]:
    from fusion.reversible import restoration as r

    mean, _ = r.restored_rows(fit, inputs)
    draws = r.draw_rows(fit, inputs, 32, key=key)
    low, high = jnp.quantile(draws, jnp.array([0.5 - LEVEL / 2, 0.5 + LEVEL / 2]), axis=0)
    return mean, (low, high)


def restoration_scores(
    found: dict[str, tuple[Any, Any]], test: Any, labels: np.ndarray, sensor: int,
    classify: Callable[[Any], Any],
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Method -> rmse in standard deviations of the sensor, coverage, accuracy with its windows.

    Args:
        found: of `restorations`.
        test, labels: clean windows and classes.
        sensor: the one that failed.
        classify: windows to class logits.
    """
    truth = test[:, sensor]
    spread = float(jnp.std(truth))
    scores: dict[str, dict[str, float]] = {}
    for name, (windows, interval) in found.items():
        error = windows - truth
        logits = np.asarray(classify(test.at[:, sensor].set(windows)))
        own = {
            "rmse": float(jnp.sqrt(jnp.mean(error**2))) / spread,
            "largest_error": float(jnp.max(jnp.abs(error))),
            "restored_accuracy": 100.0 * float(np.mean(logits.argmax(-1) == labels)),
        }
        if interval is not None:
            inside = (truth >= interval[0]) & (truth <= interval[1])
            own["coverage_90"] = 100.0 * float(jnp.mean(inside))
        scores[name] = own
    return scores


def restored_scores(
    settings: Any, dataset: Any, noise: Any, scored_on: Any, sensors: dict[str, int], seed: int
) -> dict[str, Any]:
    """Sensor -> method -> scores, of a network that is trained for it.

    Args:
        settings, noise: of its training.
        dataset: its training rows, and as test rows windows of people that those have not.
        scored_on: its test windows are restored.
        sensors: which fail, one at a time, and their places.
        seed: of everything.
    """
    from fusion.loop import fit
    from fusion.models import export, init, predict

    key, model = jax.random.key(seed), settings.model
    parts = settings.model, settings.train, settings.hyper
    main = export(fit(*parts, dataset, noise, key=key).state.params)
    drawn = export(init(key, model))["encoder"]
    chosen = np.random.default_rng(seed).permutation(len(scored_on.test_y))[:TEST_ROWS]
    test, labels = jnp.asarray(scored_on.test_x[chosen]), scored_on.test_y[chosen]
    classify = jax.jit(lambda x: predict(model, main, x).logits)
    trunk, sets = model.encoder.reversible, (dataset.train_x, dataset.test_x)
    train, held = (jnp.asarray(x) for x in sets)
    found = {}
    for name, sensor in sensors.items():
        restored = restorations(trunk, main["encoder"], drawn, train, held, test, sensor, key=key)
        found[name] = restoration_scores(restored, test, labels, sensor, classify)
    return found
