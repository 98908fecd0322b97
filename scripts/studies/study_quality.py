"""From which numbers of the raw readings a failing sensor is told, kinds not seen in training too.

    python scripts/studies/study_quality.py --data SIM --split test

SIM is a folder of prepared frames (`scripts/train_detector.py prepare`). The gate's `QualityHead`
(`monotonic`) is trained on its own as in a detector's training (pairs of frames of which a third
has a failing camera and a third a failing lidar, 1,500 steps of Adam), on deviations of the raw
statistics from those of clean frames; and so are networks of 16 hidden units on the statistics as
they are (`raw`) and on their deviations (`deviations`), with all kinds of failure and with each
third of them left out (`_unseen`). The untrained opponent is the mean squared deviation of the
sensor (`distance`). Measured is the AUROC of the told log odds, working against failing sensors of
one kind and severity; severities 1, 2 and 5 of 5. Writes `results/study_quality.json` (`_val` is
added to tables of validation frames). Four CPU-minutes, most of it failures of 400 frames.
"""

from __future__ import annotations

import dataclasses
import zlib
from pathlib import Path
from typing import Any, Literal, NamedTuple

from snn_fusion_failure.commands.detector_options import SizeOption
from snn_fusion_failure.records.detector_folds import FOLDS
from snn_fusion_failure.records.rows import Compared, column_cells, record_table
from snn_fusion_failure.runs import enable_compilation_cache, print_result, repository, run_command

TITLE = "AUROC of told sensor failures, by what the head reads"
LEVELS = (1, 2, 5)
RATE, WIDTH = 2e-3, 16  # of the detector's preset `small`


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and test the head that tells failures."""

    data: Path
    """Folder of frames."""
    size: SizeOption = "small"
    cache: Path | None = None
    """Where the prepared examples are; DATA/cache_SIZE when left out."""
    split: Literal["val", "test"] = "val"
    frames: int = 400
    """Training frames, the first ones."""
    steps: int = 1500
    seeds: int = 5
    results: Path = repository.RESULTS


class Read(NamedTuple):
    """Statistics of both sensors by kind: `clean`, or a failure and its severity in fifths."""

    train: dict[Any, Any]
    test: dict[Any, Any]


def read_statistics(config: Config) -> Read:
    """Statistics of every frame, clean and with every failure (any severity in training)."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from fusion.detection.learning.cache import open_cache, read_example
    from fusion.detection.learning.examples import make_inputs
    from fusion.detection.learning.training import SENSOR_FAILURES, fail_sensor
    from fusion.detection.sensors import quality_statistics

    cache = open_cache(config.cache or config.data / f"cache_{config.size}")
    detector = cache.config("dense")

    def run(kind: str | None) -> Any:
        def one(example: Any, severity: Any, key: Any) -> Any:
            if kind is None:
                inputs = make_inputs(detector, example)
            else:
                inputs = fail_sensor(detector, example, kind, severity, key=key)
            return quality_statistics(detector.bev, inputs.image[None], inputs.bev[None])

        return jax.jit(one)

    def of(split: str, names: Any, kind: str | None, levels: tuple[int | None, ...]) -> Any:
        statistics = run(kind)
        found: dict[Any, list[Any]] = {level: [] for level in levels}
        for i, name in enumerate(names):
            example = read_example(cache.examples(split), name)
            key = jax.random.fold_in(jax.random.key(zlib.crc32(f"{split} {kind}".encode())), i)
            for level in levels:
                drawn = jax.random.uniform(jax.random.fold_in(key, 1), minval=0.5)
                severity = drawn if level is None else jnp.float32(level / 5)
                found[level].append(statistics(example, severity, key))
        return {
            level: tuple(np.concatenate([np.asarray(r[k]) for r in rows]) for k in (0, 1))
            for level, rows in found.items()
        }

    train: dict[Any, Any] = {}
    test: dict[Any, Any] = {}
    names = cache.names("train")[: config.frames], cache.names(config.split)
    train["clean"] = of("train", names[0], None, (None,))[None]
    test["clean"] = of(config.split, names[1], None, (None,))[None]
    for kind in SENSOR_FAILURES:
        train[kind] = of("train", names[0], kind, (None,))[None]
        for level, values in of(config.split, names[1], kind, LEVELS).items():
            test[kind, level] = values
        print(kind, flush=True)
    return Read(train, test)


def network() -> Any:
    """A head of any function, that was the detector's until kinds left out showed what it does."""
    import flax.linen as nn

    layers: list[Any] = [nn.Dense(WIDTH, name="quality"), lambda x: nn.leaky_relu(x, 0.1)]
    return nn.Sequential([*layers, nn.Dense(2, name="failed")])


def monotonic(n_image: int) -> Any:
    """The detector's head, on deviations of both sensors side by side."""
    import flax.linen as nn

    from fusion.detection.network.heads import QualityHead

    class Split(nn.Module):
        @nn.compact
        def __call__(self, x: Any) -> Any:
            return QualityHead()((x[..., :n_image], x[..., n_image:]))

    return Split()


def fit_head(head: Any, train: dict[Any, Any], seen: list[str], *, steps: int, seed: int) -> Any:
    """The trained head as a function of inputs `[b, n]`; batches as a detector's training draws."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import optax

    from fusion.detection.learning.gate_objective import failure_loss
    from fusion.detection.network.initialize import init_weights

    rng = np.random.RandomState(seed)
    by_sensor = [[k for k in seen if k.startswith(s)] for s in ("camera", "lidar")]
    n = len(train["clean"])
    which = rng.randint(3, size=2 * steps)  # camera, lidar, none
    rows = []
    for sensor in which.tolist():
        kind = rng.choice(by_sensor[sensor]) if sensor < 2 else "clean"
        rows.append(train[kind][rng.randint(n)])
    failed = jnp.asarray(np.stack([which == 0, which == 1], axis=1)).reshape(steps, 2, 2)
    given = jnp.asarray(np.stack(rows), jnp.float32).reshape(steps, 2, -1)
    params = init_weights(jax.random.key(seed), head, given[0], scales={"failed": 0.01})
    warm = optax.warmup_cosine_decay_schedule(0.0, RATE, steps // 20, steps)
    optimizer = optax.adam(warm)

    def loss(params: Any, given: Any, failed: Any) -> Any:
        logits: Any = head.apply(params, given)
        return failure_loss(logits, failed)

    def step(carry: Any, batch: Any) -> Any:
        params, state = carry
        slope = jax.grad(loss)(params, *batch)
        updates, state = optimizer.update(slope, state)
        return (optax.apply_updates(params, updates), state), None

    train_all = jax.jit(lambda p: jax.lax.scan(step, (p, optimizer.init(p)), (given, failed))[0][0])
    fitted = train_all(params)
    return lambda x: np.asarray(head.apply(fitted, jnp.asarray(x, jnp.float32)))


def scores(config: Config, read: Read) -> dict[tuple[str, str], dict[int, dict[str, float]]]:
    """(row, model) -> seed -> AUROC."""
    import jax.numpy as jnp
    import numpy as np

    from fusion.detection.learning.training import SENSOR_FAILURES
    from fusion.detection.sensors import deviations, fit_clean
    from fusion.evaluate import auroc

    clean = [fit_clean(part[:256]) for part in read.train["clean"]]

    def join(both: Any, away: bool) -> Any:
        parts = both
        if away:
            parts = [
                np.asarray(deviations(c, jnp.asarray(x))) for c, x in zip(clean, both, strict=True)
            ]
        return np.concatenate(parts, axis=1)

    found: dict[tuple[str, str], dict[int, dict[str, float]]] = {}

    def note(model: str, tell: Any, test: Any, kinds: Any, seed: int) -> None:
        for kind in kinds:
            sensor = 0 if kind.startswith("camera") else 1
            for level in LEVELS:
                a = auroc(tell(test[kind, level])[:, sensor], tell(test["clean"])[:, sensor])
                row = found.setdefault((f"{kind} {level}", model), {})
                row[seed] = {"failed_auroc": a}

    n_image = read.train["clean"][0].shape[1]

    def distance(x: Any) -> Any:
        return np.stack([(x[:, :n_image] ** 2).mean(1), (x[:, n_image:] ** 2).mean(1)], axis=1)

    heads = (
        ("raw", False, network()), ("deviations", True, network()),
        ("monotonic", True, monotonic(n_image)),
    )  # fmt: skip
    for name, away, head in heads:
        train = {k: join(v, away) for k, v in read.train.items()}
        test = {k: join(v, away) for k, v in read.test.items()}
        for seed in range(config.seeds):
            for left in ((), *FOLDS):
                seen = [k for k in SENSOR_FAILURES if k not in left]
                tell = fit_head(head, train, seen, steps=config.steps, seed=seed)
                note(f"{name}_unseen" if left else name, tell, test, left or seen, seed)
            if name == "monotonic":
                note("distance", distance, test, SENSOR_FAILURES, seed)
    return found


def main(config: Config) -> dict[str, Any]:
    """Read, train, test; write the table."""
    enable_compilation_cache()
    found = scores(config, read_statistics(config))
    rows = [
        {"row": row, "model": model, "split": config.split} | cell
        for (row, model), by_seed in found.items()
        for cell in column_cells(by_seed, {"failed_auroc": "1"})
    ]
    name = "study_quality" if config.split == "test" else "study_quality_val"
    pairs = (
        ("deviations", "raw"), ("monotonic", "deviations"), ("deviations_unseen", "raw_unseen"),
        ("monotonic_unseen", "deviations_unseen"), ("monotonic_unseen", "distance"),
    )  # fmt: skip
    record_table(
        config.results / f"{name}.json", name, TITLE, rows, preset=config.size,
        compared=[Compared("failed_auroc", pairs)],
    )  # fmt: skip
    least = {
        model: min(r["mean"] for r in rows if r["model"] == model)
        for model in {r["model"] for r in rows}
    }
    print_result(**{f"least_{model}": value for model, value in sorted(least.items())})
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
