"""The simulated set: its claimed best accuracy against two other ways to get it."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from fusion.data import validation_split
from fusion.data.dataset import Dataset, apply_scale, check_dataset, draw_groups, fit_scale
from fusion.data.fixed import published_fixed
from fusion.data.simulated import SimulatedConfig, bayes_accuracy, load_simulated, oracle_accuracy
from fusion.failures import fixed_failing, generalisation, no_failure, random_failing

CONFIG = SimulatedConfig(n_train=64, n_test=20_000)


@pytest.fixture(scope="module")
def data() -> Dataset:
    return load_simulated(CONFIG, seed=7)


def matched_filter_accuracy(data: Dataset, config: SimulatedConfig, sensors: list[int]) -> float:
    """The best rule, written out: combine phasors by the inverse covariance, take the longest."""
    low, high = data.scale.low[:, None], data.scale.high[:, None]
    x = (data.test_x.astype(np.float64) + 1.0) / 2.0 * (high - low) + low
    spectrum = np.fft.rfft(x[:, sensors], axis=2)[:, :, 2 : 2 + config.n_classes]
    k = len(sensors)
    noise = np.full((k, k), config.correlation)
    noise[np.diag_indices(k)] = 1.0 + config.floor**2
    amplitude = (config.gains * np.exp(1j * config.lags))[sensors]
    filters = np.linalg.solve(noise, amplitude).conj()
    return float(
        (np.abs(np.einsum("k,nkc->nc", filters, spectrum)).argmax(1) == data.test_y).mean()
    )


@pytest.mark.parametrize("sensors", [[0], [3], [5], [0, 1], [1, 4, 5], [0, 1, 2, 3, 4, 5]])
def test_best_rule_reaches_the_claimed_accuracy(data: Dataset, sensors: list[int]) -> None:
    """Within 3.5 standard errors of 20,000 windows."""
    claimed = bayes_accuracy(CONFIG, sensors)
    error = (claimed * (1.0 - claimed) / CONFIG.n_test) ** 0.5
    assert abs(matched_filter_accuracy(data, CONFIG, sensors) - claimed) < 3.5 * error + 2e-4


@pytest.mark.parametrize("n_classes", [2, 3, 6])
@pytest.mark.parametrize("gain", [0.5, 2.0, 4.0])
def test_closed_form_equals_numerical_integration(n_classes: int, gain: float) -> None:
    """P(the Rice envelope of the right class exceeds C - 1 Rayleigh envelopes)."""
    config = SimulatedConfig(n_channels=1, n_classes=n_classes, gain=(gain, gain), floor=0.5)
    snr = gain / (1.0 + 0.5**2) ** 0.5
    value, _ = integrate.quad(
        lambda r: stats.rice.pdf(r, snr) * stats.rayleigh.cdf(r) ** (n_classes - 1), 0.0, snr + 12.0
    )
    assert bayes_accuracy(config) == pytest.approx(value, abs=1e-8)


@given(
    gain=st.floats(0.2, 4.0),
    rho=st.floats(0.0, 0.9),
    lag=st.floats(-1.0, 1.0),
    seed=st.integers(0, 99),
)
@settings(max_examples=25, deadline=None)
def test_a_sensor_more_never_hurts(gain: float, rho: float, lag: float, seed: int) -> None:
    config = SimulatedConfig(gain=(gain, 2.0 * gain), correlation=rho, lag=lag)
    order = np.random.default_rng(seed).permutation(config.n_channels)
    path = [bayes_accuracy(config, order[:k]) for k in range(config.n_channels + 1)]
    assert path[0] == pytest.approx(1.0 / config.n_classes)
    assert all(b >= a - 1e-12 for a, b in itertools.pairwise(path)) and path[-1] <= 1.0


def test_oracle_accuracy_is_the_mean_over_failing_sets() -> None:
    config = dataclasses.replace(CONFIG, n_channels=3)
    names = ("a", "b", "c")
    single = np.mean([bayes_accuracy(config, [k]) for k in range(3)])
    pairs = np.mean([bayes_accuracy(config, s) for s in ([0, 1], [0, 2], [1, 2])])
    whole = bayes_accuracy(config)
    assert oracle_accuracy(config, no_failure(names)) == pytest.approx(whole)
    assert oracle_accuracy(config, random_failing(names, 1)) == pytest.approx(
        (whole + 2 * single) / 3
    )
    _, test = generalisation(names, (1, 1), (1, 2), clean_fraction=0.0)
    assert oracle_accuracy(config, test) == pytest.approx((single + pairs) / 2)
    fixed = fixed_failing(names, ["b"], clean_fraction=0.5)
    assert oracle_accuracy(config, fixed) == pytest.approx(
        (whole + bayes_accuracy(config, [0, 2])) / 2
    )
    with pytest.raises(ValueError, match=r"protocol.n_channels=3: expected 6"):
        oracle_accuracy(CONFIG, fixed)


def test_same_seed_same_set_and_sensors_are_correlated(data: Dataset) -> None:
    again = load_simulated(CONFIG, seed=7)
    np.testing.assert_array_equal(again.test_x, data.test_x)
    assert not np.array_equal(load_simulated(CONFIG, seed=8).train_x, data.train_x)
    assert np.bincount(data.test_y).tolist() == [5000] * 4
    flat = data.test_x.transpose(1, 0, 2).reshape(CONFIG.n_channels, -1)
    correlation = np.corrcoef(flat)[np.triu_indices(CONFIG.n_channels, 1)]
    assert (correlation > 0.1).all()
    assert np.abs(data.train_x).max() == 1.0


def test_validation_split_holds_out_whole_groups() -> None:
    data = load_simulated(SimulatedConfig(n_train=100, n_test=8))
    part = validation_split(data)
    assert len(part.test_y) == 20 and not set(part.test_group) & set(part.train_group)
    with pytest.raises(ValueError, match=r"fraction=1.5: expected a number in \(0, 1\)"):
        validation_split(data, fraction=1.5)
    with pytest.raises(ValueError, match="both parts need rows"):
        validation_split(data, groups=range(10))
    with pytest.raises(ValueError, match=r"n_clean=3: expected one of"):
        published_fixed(data, 3)


def test_groups_of_one_class_are_drawn_class_by_class() -> None:
    groups = np.repeat(np.arange(12), 3)
    labels = np.repeat(np.arange(3), 12)
    for seed in range(5):
        chosen = draw_groups(groups, labels, fraction=0.2, seed=seed)
        assert np.bincount(chosen // 4, minlength=3).tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match="group 2 alone holds class 1"):
        draw_groups(np.array([0, 1, 2]), np.array([0, 0, 1]), fraction=0.2, seed=0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"n_channels": 0}, "n_channels=0"),
        ({"n_classes": 1}, "n_classes=1"),
        ({"n_train": 3}, "n_train=3: expected a whole number of at least 4"),
        ({"n_time": 12}, "n_time=12: expected a whole number of at least 13"),
        ({"correlation": 1.0}, r"correlation=1.0: expected a number in \[0, 1\)"),
        ({"gain": (2.0, 1.0)}, "weakest, strongest"),
        ({"floor": -0.1}, "floor=-0.1"),
    ],
)
def test_config_is_checked(changes: dict, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        SimulatedConfig(**changes)


@pytest.mark.parametrize(
    ("field", "change", "expected"),
    [
        ("train_y", lambda a: np.where(a == 2, 1, a), r"no example of \['rhythm_2'\]"),
        ("train_y", lambda a: a[:-1], r"y has shape \(63,\)"),
        ("test_y", lambda a: a + 1, r"labels span 1..4, expected 0..3"),
        ("test_x", lambda a: a[:, :5], r"expected \[N > 0, 6 channels, T\]"),
        ("test_x", lambda a: a * np.nan, "NaN or infinite"),
        ("train_x", lambda a: 2.0 * a, r"values reach 2, expected \[-1, 1\]"),
    ],
)
def test_check_dataset(data: Dataset, field: str, change, expected: str) -> None:
    broken = dataclasses.replace(data, **{field: change(getattr(data, field))})
    with pytest.raises(ValueError, match=expected):
        check_dataset(broken)
    assert check_dataset(data) is data


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
@settings(max_examples=25, deadline=None)
def test_scaling_is_affine_onto_the_range(seed: int, width: float, shift: float) -> None:
    x = np.random.default_rng(seed).normal(size=(5, 2, 3)) * width + shift
    y = apply_scale(x, fit_scale(x, ("a", "b")))
    np.testing.assert_allclose(y.min(axis=(0, 2)), -1.0, atol=1e-6)
    np.testing.assert_allclose(y.max(axis=(0, 2)), 1.0, atol=1e-6)
    again = apply_scale(y, fit_scale(y, ("a", "b")))
    np.testing.assert_allclose(again, y, atol=1e-6)


def test_scaling_refuses_what_it_cannot_scale() -> None:
    with pytest.raises(ValueError, match=r"channel 'b' is constant \(0\)"):
        fit_scale(np.array([[[1.0], [0.0]], [[2.0], [0.0]]]), ("a", "b"))
    with pytest.raises(ValueError, match="channel 'a' of the training rows holds NaN"):
        fit_scale(np.array([[[np.nan]], [[1.0]]]), ("a",))
