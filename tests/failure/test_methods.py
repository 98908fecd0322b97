"""What a search is given is used or refused, never replaced."""

import dataclasses

import pytest

from failure.models.acquisition import AcquisitionConfig
from failure.models.kernels import GPConfig
from failure.rev_argate import RevArgateConfig, RevArgateTrainParams
from failure.search.methods import METHODS, SearchConfig
from failure.search.task import Task, sign_of
from failure.search.turbo import TurboConfig

TASK = Task("box", 3.0, 10)
PBO = AcquisitionConfig(name="pbo", batch_size=5)


def test_given_kernel_acquisition_and_batch_are_kept():
    config = SearchConfig(TASK, "full", gp=GPConfig(kernel="rbf"), acquisition=PBO)
    assert config.gp.kernel == "rbf"
    assert (config.acquisition.name, config.acquisition.batch_size) == ("pbo", 5)
    three = dataclasses.replace(PBO, batch_size=3)
    assert SearchConfig(TASK, "pbo", acquisition=three).acquisition.batch_size == 3
    noisy = SearchConfig(TASK, "full_linear", gp=GPConfig(kernel="linear", min_noise=1e-2))
    assert noisy.gp.min_noise == 1e-2


def test_what_is_left_out_is_the_methods_own_choice():
    for name, method in METHODS.items():
        config = SearchConfig(TASK, name)
        if method.surrogate:
            assert config.gp.kernel == method.kernel
            assert config.acquisition.name == method.acquisition
            assert config.acquisition.batch_size == method.batch_size
        else:
            assert config.gp is config.acquisition is config.refit_every is None
    assert SearchConfig(TASK, "hdbo").embedding_dim == 4
    assert SearchConfig(TASK, "rev_argate_bnn").retrain_every == 50
    assert SearchConfig(TASK, "turbo").turbo == TurboConfig()


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("full_linear", {"gp": GPConfig(kernel="rbf")}, "gp.kernel='rbf': expected 'linear'"),
        ("pbo", {"acquisition": AcquisitionConfig()}, "acquisition.name='log_ei': expected 'pbo'"),
        ("monte_carlo", {"gp": GPConfig()}, "gp=GPConfig"),
        ("ridge_corner", {"acquisition": PBO}, "acquisition=AcquisitionConfig"),
        ("gradient_corner", {"refit_every": 4}, "refit_every=4: expected nothing"),
        ("full", {"embedding_dim": 3}, "embedding_dim=3: expected nothing with method 'full'"),
        ("full", {"turbo": TurboConfig()}, "turbo=TurboConfig"),
        ("hdbo", {"retrain_every": 5}, "retrain_every=5: expected nothing"),
        ("full", {"rev_argate": RevArgateConfig()}, "rev_argate=RevArgateConfig"),
        ("hdbo", {"rev_argate_training": RevArgateTrainParams()}, "rev_argate_training="),
        ("rev_argate_bnn", {"retrain_every": -1}, "retrain_every=-1: expected at least 0"),
        ("full", {"refit_every": 0}, "refit_every=0"),
    ],
)
def test_what_a_method_cannot_use_is_refused(method, changes, message):
    with pytest.raises(ValueError, match=message):
        SearchConfig(TASK, method, **changes)


def test_numbers_are_checked_where_they_are_given():
    with pytest.raises(ValueError, match=r"noise_prior=\(0\.0, -1\.0\)"):
        GPConfig(noise_prior=(0.0, -1.0))
    with pytest.raises(ValueError, match=r"beta=-1\.0"):
        AcquisitionConfig(name="lcb", beta=-1.0)
    with pytest.raises(ValueError, match=r"length_init=3\.0"):
        TurboConfig(length_init=3.0)
    with pytest.raises(ValueError, match="failure_tolerance=0"):
        TurboConfig(failure_tolerance=0)
    with pytest.raises(ValueError, match="sense='mni': expected 'max'"):
        sign_of("mni")
