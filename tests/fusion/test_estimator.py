"""The scikit-learn estimators: cloned, grid-searched and piped as others are."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sklearn = pytest.importorskip("sklearn")

from sklearn.base import clone  # noqa: E402
from sklearn.exceptions import NotFittedError  # noqa: E402
from sklearn.model_selection import cross_val_score  # noqa: E402
from sklearn.utils import get_tags  # noqa: E402
from sklearn.utils.estimator_checks import estimator_checks_generator  # noqa: E402

from fusion.estimator import ARGateClassifier, ARGateRegressor  # noqa: E402
from fusion.fitted_sensors import FittedSensors  # noqa: E402

pytestmark = pytest.mark.relaxed

RNG = np.random.default_rng(0)
Y = np.array(["idle", "busy"])[RNG.integers(0, 2, 400)]
X = np.where(Y == "busy", 1.0, -1.0)[:, None] * np.array([1.0, 50.0, 1e-3, 4.0]) + np.array(
    [0.4, 20.0, 4e-4, 1.6]
) * RNG.normal(size=(400, 4))
SMALL = ARGateClassifier(
    epochs=12, features=6, gate_width=6, head_width=8, batch_size=16, learning_rate=1e-2
)


def test_it_fits_scores_and_survives_a_missing_sensor() -> None:
    model = clone(SMALL).fit(X, Y)
    assert model.classes_.tolist() == ["busy", "idle"] and model.n_features_in_ == 4
    assert model.score(X, Y) > 0.9
    gone = X.copy()
    gone[:, 1] = np.nan
    assert (model.predict(gone) == Y).mean() > 0.9
    found = model.predict_sensors(gone)
    assert found.failed[:, 1].all() and (found.weights[:, 1] == 0).all()
    np.testing.assert_allclose(model.predict_proba(X).sum(1), 1.0, rtol=1e-5)
    with pytest.raises(ValueError, match="infinity"):
        model.predict(np.where(X > 0, np.inf, X))


def test_scikit_learn_can_use_it() -> None:
    assert clone(SMALL).set_params(seed=3).get_params()["seed"] == 3
    assert cross_val_score(SMALL, X, Y, cv=2).min() > 0.8
    with pytest.raises(NotFittedError):
        SMALL.predict(X)
    with pytest.raises(ValueError, match="contains NaN"):
        clone(SMALL).fit(np.full_like(X, np.nan), Y)


def test_numbers_are_told_in_their_units_with_a_sensor_missing(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    level = rng.normal(size=400)
    gain, spread = np.array([1.0, 50.0, 1e-3, 4.0]), np.array([0.2, 10.0, 2e-4, 0.8])
    windows = level[:, None] * gain + spread * rng.normal(size=(400, 4))
    windows[:20, 2] = np.nan  # in training, too
    y = 300.0 + 25.0 * level
    model = ARGateRegressor(epochs=12, features=6, width=8, learning_rate=1e-2).fit(windows, y)
    assert model.predict(windows).shape == (400,) and model.score(windows, y) > 0.85
    gone = windows.copy()
    gone[:, 1] = np.nan
    assert model.score(gone, y) > 0.8
    found = model.predict_sensors(gone)
    assert not found.available[:, 1].any() and (found.weights[:, 1] == 0).all()
    model.fitted_.save(tmp_path / "net.npz")
    again = FittedSensors.load(tmp_path / "net.npz").predict(
        [gone[:, k, None, None] for k in range(4)]
    )
    np.testing.assert_array_equal(again.output, found.output)


def test_few_rows_calibrate_at_the_rate_that_they_allow() -> None:
    small = clone(SMALL).set_params(epochs=1, batch_size=8)
    model = small.fit(X[:40], Y[:40])
    assert model.fitted_.false_alarm_rate == 1 / 8
    with pytest.raises(ValueError, match=r"false_alarm_rate=0\.01: expected at least 1 / 8"):
        clone(small).set_params(false_alarm_rate=0.01).fit(X[:40], Y[:40])


QUICK = (
    *("check_estimator_cloneable", "check_estimator_tags_renamed", "check_valid_tag_types"),
    *("check_estimator_repr", "check_no_attributes_set_in_init", "check_estimators_unfitted"),
)
"""Checks of scikit-learn that train nothing."""
DOES_NOT_APPLY = {
    "check_estimators_nan_inf": "predict reads NaN as an absent sensor; training and infinity are "
    "checked by tests of their own",
}

UNTYPED = ("check_do_not_raise_errors_in_init_or_set_params",)
"""Checks that give numbers for names, which the suite refuses before the code under test is run."""


def _checks() -> Iterator[Any]:
    """All checks of scikit-learn, for networks that are small and still learn its easy tasks."""
    fast: dict[str, Any] = {"epochs": 12, "features": 6, "batch_size": 16, "learning_rate": 1e-2}
    for estimator in (
        ARGateClassifier(gate_width=6, head_width=8, **fast),
        ARGateRegressor(width=8, **fast),
    ):
        for one, check in estimator_checks_generator(estimator):
            plain = getattr(check, "func", check).__name__
            options = "-".join(map(str, getattr(check, "keywords", {}).values()))
            marks = [] if plain in QUICK else [pytest.mark.slow]
            if why := DOES_NOT_APPLY.get(plain):
                marks.append(pytest.mark.xfail(reason=why, strict=True))
            if plain in UNTYPED:
                marks.append(pytest.mark.skip("needs a process without runtime type checks"))
            name = f"{type(one).__name__}-{plain}-{options}"
            yield pytest.param(one, check, id=name, marks=marks)


@pytest.mark.parametrize(("estimator", "check"), list(_checks()))
def test_checks_of_scikit_learn_pass(estimator: Any, check: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the checks' own
        check(estimator)


def test_an_oracle_is_refused_and_training_rows_of_a_classifier_hold_no_nan() -> None:
    with pytest.raises(ValueError, match="model='oracle': expected one of 'baseline'"):
        clone(SMALL).set_params(model="oracle").fit(X, Y)
    # Pipelines ask the tags whether training takes NaN, which means an absent sensor in predict.
    assert not get_tags(SMALL).input_tags.allow_nan
    assert get_tags(ARGateRegressor()).input_tags.allow_nan


@pytest.mark.slow
def test_a_single_sensor_is_fitted() -> None:
    alone = clone(SMALL).set_params(epochs=1).fit(X[:, :1], Y)
    assert alone.predict(X[:, :1]).shape == Y.shape


@pytest.mark.parametrize("kind", [ARGateClassifier, ARGateRegressor])
def test_what_is_no_table_of_sensors_is_refused(kind: Any) -> None:
    numbers = np.arange(400) % 2
    with pytest.raises(ValueError, match=r"expected .rows, sensors"):
        kind().fit(np.zeros((400, 2, 2, 2)), numbers)
    with pytest.raises(ValueError, match="requires y to be passed"):
        kind().fit(X, None)
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        kind().fit(X, numbers[:-1])
