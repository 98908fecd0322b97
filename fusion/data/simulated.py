r"""Simulated windows of correlated sensors whose best possible accuracy is known.

All K sensors watch one rhythm. Its frequency is the class, its phase is unknown:

.. math:: x_k(t) = a_k\, s_y(t; \theta + \varphi_k) + \sum_c \left(u_{kc} \cos + v_{kc} \sin\right)
    + \epsilon_k(t), \qquad
    s_c(t; \theta) = \sqrt{2/T} \cos(2\pi f_c t / T + \theta)

with :math:`\theta` uniform, :math:`u_c, v_c \sim N(0, \Sigma)` noise at each class frequency that
the sensors share in part, :math:`\Sigma = (1 - \rho) I + \rho\, 1 1^T`, and white noise
:math:`\epsilon \sim N(0, \sigma_\epsilon^2)`. The frequencies are whole cycles per window, so that
the problem is non-coherent detection of orthogonal signals, which has a closed form.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from fusion._checks import check_count, check_number
from fusion.data.dataset import Dataset, apply_scale, check_dataset, fit_scale
from fusion.failures import Protocol

FIRST_CYCLES = 2  # cycles per window of class 0
N_SUBJECTS = 10  # groups of the training rows, for a validation split by group


@dataclasses.dataclass(frozen=True)
class SimulatedConfig:
    """Sizes and difficulty of the simulated set.

    Attributes:
        n_train, n_test: windows.
        n_channels: K sensors; n_classes: C rhythms; n_time: T samples, T / 2 > C + 2.
        gain: amplitudes :math:`a_k` of the weakest and the strongest sensor, spaced evenly between.
        correlation: :math:`\\rho` in [0, 1), the noise that sensors share.
        lag: phase :math:`\\varphi_k` between neighbouring sensors [rad].
        floor: :math:`\\sigma_\\epsilon`, sd of the white noise.
    """

    n_train: int = 2048
    n_test: int = 1024
    n_channels: int = 6
    n_classes: int = 4
    n_time: int = 32
    gain: tuple[float, float] = (1.5, 3.0)
    correlation: float = 0.3
    lag: float = 0.3
    floor: float = 0.3

    def __post_init__(self) -> None:
        """Check every field."""
        check_count("n_channels", self.n_channels)
        check_count("n_classes", self.n_classes, 2)
        for name in ("n_train", "n_test"):
            check_count(name, getattr(self, name), self.n_classes)
        check_count("n_time", self.n_time, 2 * (self.n_classes + FIRST_CYCLES) + 1)
        check_number("correlation", self.correlation, 0.0, 1.0, below=True)
        weakest, strongest = self.gain
        check_number("gain[0]", weakest, 0.0, above=True, fix="an amplitude is positive")
        check_number("gain[1]", strongest, weakest, fix="give (weakest, strongest)")
        check_number("floor", self.floor, 0.0, fix="it is a standard deviation")

    @property
    def gains(self) -> np.ndarray:
        """Amplitude of each sensor, `[K]`."""
        return np.linspace(*self.gain, self.n_channels)

    @property
    def lags(self) -> np.ndarray:
        """Phase of each sensor [rad], `[K]`."""
        return self.lag * np.arange(self.n_channels)

    @property
    def covariance(self) -> np.ndarray:
        """Noise covariance of the sensors at a class frequency, without the floor, `[K, K]`."""
        k = self.n_channels
        return (1.0 - self.correlation) * np.eye(k) + self.correlation * np.ones((k, k))


def _draw(config: SimulatedConfig, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """n windows `[n, K, T]` float64 and their labels, balanced to within one."""
    k, t = config.n_channels, config.n_time
    y = rng.permutation(np.arange(n) % config.n_classes)
    cycles = FIRST_CYCLES + np.arange(config.n_classes)
    angle = 2.0 * np.pi * cycles[:, None] * np.arange(t)[None, :] / t
    # Amplitude and phase of every class frequency as one complex number (a phasor).
    root = np.linalg.cholesky(config.covariance)
    noise = rng.standard_normal((2, n, k, config.n_classes))
    u, v = np.einsum("kj,anjc->ankc", root, noise)
    phasor = u - 1j * v
    theta = rng.uniform(0.0, 2.0 * np.pi, n)
    phasor[np.arange(n), :, y] += config.gains * np.exp(1j * (theta[:, None] + config.lags))
    x = math.sqrt(2.0 / t) * np.real(phasor @ np.exp(1j * angle))
    return x + config.floor * rng.standard_normal((n, k, t)), y


def load_simulated(config: SimulatedConfig | None = None, *, seed: int = 0) -> Dataset:
    """Draw the simulated set; the same config and seed give the same arrays.

    Returns:
        Dataset with x `[N, K, T]`; groups number the rows round and have no effect of their own.

    Example:
        >>> load_simulated(SimulatedConfig(n_train=64, n_test=32)).train_x.shape
        (64, 6, 32)
    """
    config = SimulatedConfig() if config is None else config
    train_rng, test_rng = np.random.default_rng(seed).spawn(2)
    train_x, train_y = _draw(config, config.n_train, train_rng)
    test_x, test_y = _draw(config, config.n_test, test_rng)
    channels = tuple(f"sensor_{k}" for k in range(config.n_channels))
    scale = fit_scale(train_x, channels)
    return check_dataset(
        Dataset(
            name="simulated",
            train_x=apply_scale(train_x, scale),
            train_y=train_y.astype(np.int32),
            test_x=apply_scale(test_x, scale),
            test_y=test_y.astype(np.int32),
            train_group=(np.arange(config.n_train) % N_SUBJECTS).astype(np.int32),
            test_group=np.full(config.n_test, N_SUBJECTS, np.int32),
            channels=channels,
            classes=tuple(f"rhythm_{c}" for c in range(config.n_classes)),
            split="subject",
            scale=scale,
            source="simulated",
        )
    )


def bayes_accuracy(
    config: SimulatedConfig, sensors: Sequence[int] | np.ndarray | None = None
) -> float:
    r"""Accuracy of the best possible classifier that sees some of the sensors.

    .. math:: P = \sum_{n=0}^{C-1} \binom{C-1}{n} \frac{(-1)^n}{n+1}
        \exp\left(-\frac{n}{n+1} \frac{\gamma}{2}\right), \qquad
        \gamma = a_S^H \left(\Sigma_{SS} + \sigma_\epsilon^2 I\right)^{-1} a_S

    Symbols: S is `sensors` (None = all, empty = chance); :math:`a_k` here is the complex
    amplitude :math:`a_k e^{i\varphi_k}`; C is `config.n_classes`. Scaling to [-1, 1] keeps it.

    Source: Proakis (2001), Digital Communications, 4th edition, section 5.4: probability of a
    correct decision for non-coherent detection of orthogonal signals, with the sensors combined by
    the matched filter.

    Example:
        >>> c = SimulatedConfig()
        >>> bayes_accuracy(c, []) == 1 / c.n_classes
        True
    """
    index = np.arange(config.n_channels) if sensors is None else np.array(sensors, dtype=int)
    gamma = 0.0
    if index.size:
        a = (config.gains * np.exp(1j * config.lags))[index]
        noise = config.covariance[np.ix_(index, index)] + config.floor**2 * np.eye(index.size)
        gamma = float(np.real(a.conj() @ np.linalg.solve(noise, a)))
    others = config.n_classes - 1
    return math.fsum(
        math.comb(others, n) * (-1) ** n / (n + 1) * math.exp(-n / (n + 1) * gamma / 2.0)
        for n in range(others + 1)
    )


def oracle_accuracy(config: SimulatedConfig, protocol: Protocol) -> float:
    """Accuracy of the best classifier that is told which channels failed.

    The mean of `bayes_accuracy` over the failing sets of the protocol and its clean share `s`,
    `s A(all) + (1 - s) mean_F A(all - F)`: no model can do better in the mean when failed channels
    read noise that is independent of the class.
    """
    k = config.n_channels
    if protocol.n_channels != k:
        raise ValueError(
            f"protocol.n_channels={protocol.n_channels}: expected {k} as in the config; build the "
            "protocol from the channels of the set"
        )
    if protocol.failing:
        corrupted = bayes_accuracy(config, sorted(set(range(k)) - set(protocol.failing)))
    else:
        counts = range(protocol.low, protocol.high + 1)
        corrupted = float(
            np.mean(
                [
                    np.mean(
                        [bayes_accuracy(config, s) for s in itertools.combinations(range(k), k - m)]
                    )
                    for m in counts
                ]
            )
        )
    clean = protocol.clean_fraction
    return clean * bayes_accuracy(config) + (1.0 - clean) * corrupted
