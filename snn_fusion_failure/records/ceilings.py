"""What rows of a data set hold at most, and what trivial learners make of them.

`forest_ceiling` is told which sensors work: it is a random forest trained on exactly these. What a
gate misses of it is not there for want of information.
"""

from __future__ import annotations

import functools
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fusion.data import Dataset
    from fusion.loop import Corruption

CEILINGS = ("forest_ceiling", "nearest_rows", "linear_fit")
"""Columns that are no network of ours."""
TREES = 25
KNN_ROWS = 4000
"""Test rows, drawn by the seed, that the nearest neighbours are looked up for."""


def _sklearn() -> Any:
    try:
        import sklearn
    except ImportError:
        raise ValueError(
            "forest_ceiling: expected scikit-learn, which is not installed; "
            "pip install 'snn-fusion-failure[sklearn]'"
        ) from None
    return sklearn


# Every seed and row of a table shares the forest on all sensors.
@functools.lru_cache(maxsize=64)
def _forest_right(dataset: Dataset, sensors: tuple[int, ...]) -> float:
    _sklearn()
    from sklearn.ensemble import RandomForestClassifier

    x = {part: getattr(dataset, f"{part}_x")[:, sensors, :] for part in ("train", "test")}
    x = {part: windows.reshape(len(windows), -1) for part, windows in x.items()}
    tries = min(3, len(sensors)) if dataset.n_time == 1 else "sqrt"
    forest = RandomForestClassifier(TREES, max_features=tries, random_state=0, n_jobs=1)
    forest.fit(x["train"], dataset.train_y)
    return 100.0 * float((forest.predict(x["test"]) == dataset.test_y).mean())


def forest_ceiling(dataset: Dataset, noise: Corruption, seed: int) -> dict[str, float]:
    """Accuracy of a forest that is told which sensors work, for one drawn set of them.

    Args:
        dataset: its test rows are scored.
        noise: of the table's row; how sensors fail does not matter to a forest that ignores them.
        seed: of the drawn sensors; other seeds draw other sets of the same size.

    Raises:
        ValueError: scikit-learn is missing, or the row has failing sets of several sizes.
    """
    protocol, k = noise.test, dataset.n_channels
    clean = _forest_right(dataset, tuple(range(k)))
    if protocol.high == 0:
        return {"accuracy": clean, "accuracy_clean": clean}
    if protocol.low != protocol.high:
        raise ValueError(
            f"noise.test.low={protocol.low}: expected {protocol.high}, one size of failing sets; "
            "leave forest_ceiling out of this row"
        )
    drawn = np.random.default_rng(seed).permutation(k)[: protocol.high]
    failing = protocol.failing or tuple(int(i) for i in drawn)
    left = _forest_right(dataset, tuple(i for i in range(k) if i not in failing))
    share = protocol.clean_fraction
    return {
        "accuracy": share * clean + (1.0 - share) * left,
        "accuracy_clean": clean,
        "accuracy_corrupted": left,
    }


def trivial(name: str, dataset: Dataset, noise: Corruption, seed: int) -> dict[str, float]:
    """Accuracy of a learner without a gate on the same corrupted rows.

    Args:
        name: `nearest_rows` looks up the five training rows that are nearest in all sensors, failed
            or not (in their ranks where they are scalars); `linear_fit` is a logistic regression of
            corrupted rows, 200 steps of L-BFGS.
        dataset, noise, seed: as in a training of ours; the same test rows.

    Raises:
        ValueError: scikit-learn is missing.
    """
    import jax
    import jax.numpy as jnp

    from fusion.evaluate import split_accuracy
    from fusion.failures import corrupt

    _sklearn()
    kind, key = noise.kind, jax.random.key(seed)
    test_key, train_key = jax.random.fold_in(key, 3), jax.random.fold_in(key, 2)
    x, failed = corrupt(
        noise.test, jnp.asarray(dataset.test_x), noise.test_kind or kind, key=test_key
    )
    queries, labels, mask = np.asarray(x), dataset.test_y, np.asarray(failed)
    if name == "nearest_rows":
        from sklearn.neighbors import KNeighborsClassifier

        # The file has one driver after the other: its first rows are those of the first.
        drawn = np.random.default_rng(seed).permutation(len(labels))[:KNN_ROWS]
        queries, labels, mask = queries[drawn], labels[drawn], mask[drawn]
        train = dataset.train_x
        if dataset.n_time == 1:
            known = np.sort(train[:, :, 0], axis=0)
            train, queries = (_ranks(known, a[:, :, 0]) for a in (train, queries))
        train, queries = (a.reshape(len(a), -1) for a in (train, queries))
        model = KNeighborsClassifier(5, algorithm="brute").fit(train, dataset.train_y)
    else:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.linear_model import LogisticRegression

        seen, _ = corrupt(noise.train, jnp.asarray(dataset.train_x), kind, key=train_key)
        train, queries = (np.asarray(a).reshape(len(a), -1) for a in (seen, queries))
        with warnings.catch_warnings():
            # The last steps of a fit to windows change nothing that counts here.
            warnings.simplefilter("ignore", ConvergenceWarning)
            model = LogisticRegression(max_iter=200).fit(train, dataset.train_y)
    found = split_accuracy(labels, model.predict(queries), mask)
    scores = {"": found.overall, "_clean": found.clean, "_corrupted": found.corrupted}
    # A clean row of a table has no corrupted part.
    return {f"accuracy{part}": 100.0 * v for part, v in scores.items() if np.isfinite(v)}


def _ranks(known: np.ndarray, x: np.ndarray) -> np.ndarray:
    columns = [np.searchsorted(known[:, k], x[:, k]) for k in range(x.shape[1])]
    return (np.stack(columns, axis=1) / len(known)).astype(np.float32)


def score(name: str, dataset: Dataset, noise: Corruption, seed: int) -> dict[str, float]:
    """Scores of one of `CEILINGS`."""
    if name == "forest_ceiling":
        return forest_ceiling(dataset, noise, seed)
    return trivial(name, dataset, noise, seed)
