"""The engine "native": what it computes is what the matrix products do, and what it refuses."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsnn
from jaxsnn import network
from jaxsnn.native import compiling

NO_COMPILER = not any(shutil.which(name) for name in ("c++", "g++", "clang++"))
needs_compiler = pytest.mark.skipif(NO_COMPILER, reason="needs a C++ compiler")
SIZES = {"control_steps": 30, "hold_steps": 30, "group_exc": 3, "group_inh": 2}


@pytest.fixture(scope="module", autouse=True)
def library_of_this_run(tmp_path_factory):
    """A cache folder of this module's own, so that the compiler is called."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def windows(config, params, key, rates=120.0):
    """Two windows in a row with a change of weights between, the second one half forgotten."""
    state, kernel = network.init(key, config, params), network.kernel(config, params)
    spikes = []
    for i in range(2):
        pre = jaxsnn.poisson_spikes(
            jnp.full(config.n_in, rates), config.hold_steps, dt=config.dt,
            key=jax.random.fold_in(key, i),
        )  # fmt: skip
        state, held, fired = network.window(config, params, kernel, state, pre, 1.0 - 0.5 * i)
        reward = jnp.array([0.5, -0.5])
        state = state._replace(
            weights=network.reinforce(config, params, state.weights, held, reward)
        )
        spikes.append(fired)
    return state, held, spikes


def small(model, reading="tuned", **changes):
    sizes = {"hidden_exc": 20, "hidden_inh": 20 if model in ("S3", "S4") else 0, **SIZES}
    return jaxsnn.preset(model, reading, config={**sizes, **changes})


def both(config):
    return config, dataclasses.replace(config, engine="native")


def assert_same(one, two, tolerance=4e-7):
    """Equal to `tolerance` of each leaf's range; spikes equal."""
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(two), strict=True
    ):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        off = np.abs(a - b).max() / max(np.abs(a).max(), 1e-9)
        assert off <= tolerance, (jax.tree_util.keystr(path), off)


@needs_compiler
@pytest.mark.parametrize(
    ("model", "reading"), [("S1", "literal"), ("S2", "tuned"), ("S3", "literal"), ("S4", "tuned")]
)
def test_windows_are_those_of_the_matrix_products(model, reading):
    config, params = small(model, reading)
    keys = jax.random.split(jax.random.key(3), 3)
    one, two = (jax.jit(jax.vmap(lambda k, c=c: windows(c, params, k)))(keys) for c in both(config))
    assert float(one[2][0].hidden.sum()) > 20
    assert_same(one, two)


@needs_compiler
def test_constants_may_be_traced_and_differ_between_robots():
    config, params = small("S4")
    gains = jnp.array([1.0, 1.5])

    def run(config, gain):
        return windows(config, params._replace(gain_input=gain), jax.random.key(5))

    one, two = (jax.jit(jax.vmap(lambda g, c=c: run(c, g)))(gains) for c in both(config))
    assert_same(one, two)


@needs_compiler
@pytest.mark.slow
def test_an_experiment_is_the_same():
    config, params = small("S4", control_steps=60)
    keys = jax.random.split(jax.random.key(0), 3)
    outs = [
        jax.jit(
            lambda keys, c=c: jaxsnn.run_experiment(
                c, jaxsnn.snn_params(c, params), jaxsnn.scenario(1),
                keys=keys, n_learn=2, n_test=1, max_steps=8, block=2,
            )
        )(keys)
        for c in both(config)
    ]  # fmt: skip
    np.testing.assert_array_equal(outs[0].learning.status, outs[1].learning.status)
    np.testing.assert_array_equal(outs[0].testing.steps, outs[1].testing.steps)
    np.testing.assert_allclose(outs[0].testing.path, outs[1].testing.path, rtol=1e-5)


@needs_compiler
def test_constants_of_single_neurons_are_refused():
    config, params = small("S4", engine="native")
    layer = params.hidden._replace(tau_m=jnp.full(config.n_hidden, 0.02))
    with pytest.raises(ValueError, match="engine='native': expected one constant for a whole"):
        windows(config, params._replace(hidden=layer), jax.random.key(0))


@needs_compiler
def test_float64_is_refused():
    config, params = small("S4", engine="native")
    with jax.enable_x64(True):
        state = network.init(jax.random.key(0), config, params)
        with pytest.raises(ValueError, match="expected float32 states and constants, got float64"):
            network.fire(config, params, state, jnp.zeros((30, config.n_in)))


def test_no_compiler_is_said(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError, match=r"CXX=no-such-compiler: expected a C\+\+ compiler"):
        compiling.library()


@needs_compiler
def test_a_source_that_does_not_compile_is_said(monkeypatch, tmp_path):
    source = tmp_path / "window.cc"
    source.write_text("no C++\n")
    monkeypatch.setattr(compiling, "SOURCE", source)
    with pytest.raises(ValueError, match=r"expected it to compile window\.cc"):
        compiling.library()


@needs_compiler
def test_the_library_is_made_once_and_anew_for_another_source(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = tmp_path / "window.cc"
    monkeypatch.setattr(compiling, "SOURCE", source)
    source.write_text("int first() { return 1; }\n")
    made = compiling.library()
    before = made.stat().st_mtime_ns
    assert compiling.library() == made and made.stat().st_mtime_ns == before
    source.write_text("int second() { return 2; }\n")
    assert compiling.library() != made
    assert sorted(made.parent.iterdir()) == sorted({made, compiling.library()})
