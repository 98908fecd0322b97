"""The scikit-learn classifier: cloned, grid-searched and piped as others are."""

from __future__ import annotations

import numpy as np
import pytest

sklearn = pytest.importorskip("sklearn")

from sklearn.base import clone  # noqa: E402
from sklearn.exceptions import NotFittedError  # noqa: E402
from sklearn.model_selection import cross_val_score  # noqa: E402

from fusion.estimator import ARGateClassifier  # noqa: E402

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


def test_scikit_learn_can_use_it() -> None:
    assert clone(SMALL).set_params(seed=3).get_params()["seed"] == 3
    assert cross_val_score(SMALL, X, Y, cv=2).min() > 0.8
    with pytest.raises(NotFittedError):
        SMALL.predict(X)
    with pytest.raises(ValueError, match="contains NaN"):
        clone(SMALL).fit(np.full_like(X, np.nan), Y)
