"""Reversible encoders: the exact inverse, the gradient and its memory, any model with them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import HyperParams, ModelConfig, export, predict, preset
from fusion.data import load
from fusion.encoders import EncoderConfig, encoder
from fusion.models import init
from fusion.presets import ENCODED
from fusion.reversible import blocks, coupling
from fusion.reversible.config import ReversibleConfig
from fusion.spiking.operations import multiply_adds
from fusion.train import batch_loss

TRUNK = ReversibleConfig(squeezes=(4, 2), channels=6, depths=(2, 3), hidden=(5, 4), taps=(3, 2))
SMALL = ModelConfig(
    "argate_l",
    n_sensors=2,
    n_times=16,
    n_classes=3,
    encoder=EncoderConfig(features=6, series="reversible", reversible=TRUNK),
    gate_width=4,
    head_widths=(8,),
    dropout=0.0,
)
X = jax.random.uniform(jax.random.key(1), (7, 2, 16), minval=-1.0)


def drawn(config: ReversibleConfig, k: int, axes: int, seed: int) -> blocks.Params:
    """Parameters with biases, as training makes them."""
    params = jax.jit(lambda key: blocks.init(key, config, k, axes=axes))(jax.random.key(seed))
    noise = jax.random.key(seed + 1)
    return {
        name: value + (0.3 * jax.random.normal(noise, value.shape) if "bias" in name else 0.0)
        for name, value in params.items()
    }


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    axes=st.integers(1, 2),
    squeezes=st.sampled_from([(1,), (2,), (2, 2), (4, 1)]),
    extra=st.integers(0, 3),
    depth=st.integers(1, 32),
    taps=st.integers(1, 4),
    centred=st.booleans(),
    seed=st.integers(0, 99),
)
def test_the_inverse_gives_the_window_back(
    axes: int, squeezes: tuple, extra: int, depth: int, taps: int, centred: bool, seed: int
) -> None:
    n = len(squeezes)
    needed = squeezes[0] ** axes + centred
    config = ReversibleConfig(
        squeezes,
        channels=needed + needed % 2 + 2 * extra,
        depths=(depth,) * n,
        hidden=(4,) * n,
        taps=(taps,) * n,
        centred=centred,
    )
    params = drawn(config, 2, axes, seed)
    x = jax.random.uniform(jax.random.key(seed), (2, 3, *(8,) * axes, 1), minval=-1.0)
    z = jax.jit(blocks.forward, static_argnums=0)(config, params, x)
    assert z.size * (needed - centred) == x.size * config.channels
    # Untouched, the trunk would be trivial to undo.
    assert float(jnp.abs(z).max()) > 0.1 and not bool(jnp.array_equal(z.ravel(), x.ravel()))
    back = jax.jit(blocks.inverse, static_argnums=0)(config, params, z)
    np.testing.assert_allclose(back, x, atol=1e-5)


def test_thirty_two_blocks_are_undone() -> None:
    config = dataclasses.replace(TRUNK, depths=(16, 16), centred=True)
    params, x = drawn(config, 2, 1, 0), jnp.transpose(X, (1, 0, 2))[..., None]
    there_and_back = jax.jit(lambda p, x: blocks.inverse(config, p, blocks.forward(config, p, x)))(
        params, x
    )
    np.testing.assert_allclose(there_and_back, x, atol=1e-5)


def test_a_squeeze_is_the_permutation_of_its_definition() -> None:
    x = np.arange(2 * 3 * 4 * 6 * 2).reshape(2, 3, 4, 6, 2).astype(np.float32)
    y = np.asarray(blocks.squeeze(jnp.asarray(x), 2))
    assert y.shape == (2, 3, 2, 3, 8)
    for i, j, di, dj, c in np.ndindex(2, 3, 2, 2, 2):
        np.testing.assert_array_equal(
            y[:, :, i, j, (di * 2 + dj) * 2 + c], x[:, :, 2 * i + di, 2 * j + dj, c]
        )
    np.testing.assert_array_equal(blocks.unsqueeze(jnp.asarray(y), 2), x)
    with pytest.raises(ValueError, match="expected axes of multiples of 4; change squeezes"):
        blocks.squeeze(jnp.asarray(x), 4)


@pytest.mark.parametrize("axes", [1, 2])
def test_one_block_is_its_equation_by_scipy(axes: int) -> None:
    """u' = u + W2 relu(W1 * v + b), v' = v + the same of u', convolutions by scipy."""
    from scipy.signal import correlate

    config = ReversibleConfig((1,), channels=4, depths=(1,), hidden=(3,), taps=(3,), gain=1.0)
    params = drawn(config, 1, axes, 0)
    x = np.random.default_rng(0).normal(size=(1, 1, *(6,) * axes, 4)).astype(np.float32)

    def drive(half: str, other: np.ndarray) -> np.ndarray:
        w, b, out = (np.asarray(params[f"stage0_{half}_{n}"])[0, 0] for n in ("in", "bias", "out"))
        kernel = w.reshape(*(3,) * axes, 2, 3)
        hidden = np.stack(
            [
                sum(correlate(other[..., c], kernel[..., c, f], "same") for c in range(2)) + b[f]
                for f in range(3)
            ],
            axis=-1,
        )
        return np.maximum(hidden, 0.0) @ out

    u, v = x[0, 0, ..., :2], x[0, 0, ..., 2:]
    u = u + drive("u", v)
    v = v + drive("v", u)
    found = blocks.forward(config, params, jnp.asarray(x))[0, 0]
    np.testing.assert_allclose(found, np.concatenate([u, v], -1), atol=1e-5)


def test_the_recomputed_gradient_is_the_stored_one() -> None:
    params = drawn(TRUNK, 2, 1, 3)
    x = jnp.transpose(X, (1, 0, 2))[..., None]

    def slopes(recompute: bool) -> tuple:
        config = dataclasses.replace(TRUNK, recompute=recompute)
        return jax.jit(
            jax.grad(lambda p, x: jnp.sum(jnp.sin(blocks.forward(config, p, x))), (0, 1))
        )(params, x)

    ours, theirs = slopes(True), slopes(False)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert float(jnp.abs(b).max()) > 1e-3
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


def test_the_recomputed_gradient_is_that_of_finite_differences() -> None:
    ours = coupling.Coupling(lambda w, v: jnp.tanh(v @ w), lambda w, u: -jnp.tanh(u @ w.T))

    def loss(w: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
        u, v = coupling.couple(ours, w, u, v)
        return jnp.sum(u**2) + jnp.sum(jnp.sin(v))

    rng = np.random.default_rng(0)
    w, u, v = (rng.normal(size=shape) for shape in ((2, 3, 3), (5, 3), (5, 3)))

    def by_hand(w: np.ndarray, u: np.ndarray, v: np.ndarray) -> float:
        for block in w:
            u = u + np.tanh(v @ block)
            v = v - np.tanh(u @ block.T)
        return float((u**2).sum() + np.sin(v).sum())

    with jax.enable_x64(True):
        found = jax.jit(jax.grad(loss, (0, 1, 2)))(*map(jnp.asarray, (w, u, v)))
    for index, slopes in enumerate(found):
        for place in ((0, 0), (1, 2), (-1, 1)) if index else ((0, 0, 1), (1, 2, 2)):
            ends = []
            for sign in (1e-5, -1e-5):
                moved = [a.copy() for a in (w, u, v)]
                moved[index][place] += sign
                ends.append(by_hand(*moved))
            np.testing.assert_allclose(slopes[place], (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


def memory(depth: int, recompute: bool) -> int:
    """Temporary memory of a compiled gradient, in bytes."""
    config = ReversibleConfig((4,), 8, (depth,), (8,), (3,), recompute=recompute)
    params = jax.eval_shape(lambda: blocks.init(jax.random.key(0), config, 1))
    x = jax.ShapeDtypeStruct((1, 256, 64, 1), jnp.float32)
    slope = jax.jit(jax.grad(lambda p, x: jnp.sum(blocks.forward(config, p, x) ** 2)))
    return int(slope.lower(params, x).compile().memory_analysis().temp_size_in_bytes)


def test_memory_of_training_does_not_grow_with_depth() -> None:
    shallow, deep = memory(4, True), memory(32, True)
    assert deep <= 1.1 * shallow
    assert memory(32, False) > 5 * deep


def test_the_encoder_is_trunk_and_readout() -> None:
    module = encoder(SMALL.encoder, 16, "encoder")
    x = jnp.transpose(X, (1, 0, 2))
    params = jax.jit(module.init)(jax.random.key(0), x)["params"]
    found = module.apply({"params": params}, x)
    z = np.maximum(np.asarray(blocks.forward(TRUNK, params, x[..., None])), 0.0)
    pooled = np.concatenate([z.mean(axis=2), z.max(axis=2)], axis=-1)
    joined = np.einsum("kbi,kif->kbf", pooled, params["conv_out_kernel"])
    assert found.shape == (2, 7, 6)
    no_spectrum = dataclasses.replace(SMALL.encoder, spectral=False)
    alone = encoder(no_spectrum, 16, "encoder").apply(
        {"params": params | {"out_kernel": params["out_kernel"][:, :6]}}, x
    )
    wanted = np.einsum("kbi,kif->kbf", np.maximum(joined, 0.0), params["out_kernel"][:, :6])
    np.testing.assert_allclose(alone, np.maximum(wanted, 0.0), atol=1e-5)


@pytest.mark.parametrize(
    "model",
    [
        "argate_l", "embracenet", pytest.param("baseline", marks=pytest.mark.slow),
        pytest.param("oracle", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_any_recipe_takes_the_reversible_encoder(model: str) -> None:
    config = dataclasses.replace(SMALL, model=model)
    params = init(jax.random.key(0), config)
    told = jnp.zeros((7, 2), bool) if config.reads_failed else None
    out = jax.jit(lambda main: predict(config, main, X, told))(export(params))
    assert out.features.shape == (2, 7, 6)
    assert bool(jnp.all(jnp.isfinite(out.logits)))


@pytest.mark.slow
def test_gradients_reach_the_trunk_unless_it_stays_as_drawn() -> None:
    labels, failed = jnp.arange(7) % 3, jnp.zeros((7, 2), bool)

    def slopes(learned: bool, gate_kind: str = "deterministic") -> dict:
        trunk = dataclasses.replace(TRUNK, learned=learned)
        coded = dataclasses.replace(SMALL.encoder, reversible=trunk)
        config = dataclasses.replace(SMALL, encoder=coded, gate_kind=gate_kind)

        def loss(p: dict) -> jax.Array:
            return batch_loss(config, HyperParams(), p, X, labels, failed, key=jax.random.key(2))[0]

        found = jax.jit(jax.grad(loss))(init(jax.random.key(0), config))
        return jax.tree.map(lambda g: float(jnp.abs(g).max()), found["main"]["encoder"])

    assert min(slopes(True).values()) > 0.0
    assert min(slopes(True, "variational").values()) > 0.0
    assert max(slopes(False).values()) == 0.0


def test_presets_of_every_data_set_have_reversible_encoders() -> None:
    for name in ("rev_conv_baseline", "rev_conv_argate"):
        made = preset(load("simulated"), name, "quick").model
        assert (made.model, made.encoder.series) == (ENCODED[name][0], "reversible")
    with pytest.raises(ValueError, match="encoder='conv': expected 'reversible', which 'rev_conv"):
        preset(load("simulated"), "rev_conv_argate", encoder="conv")


def test_scalars_enter_by_their_octaves_and_come_back() -> None:
    trunk = ReversibleConfig((1,), channels=18, depths=(2,), hidden=(4,), taps=(1,))
    config = EncoderConfig(features=5, series="reversible", reversible=trunk)
    module, x = encoder(config, 1, "encoder"), X[:, :, :1].transpose(1, 0, 2)
    params = jax.jit(module.init)(jax.random.key(0), x)["params"]
    assert module.apply({"params": params}, x).shape == (2, 7, 5)
    assert params["out_kernel"].shape == (2, 18, 5)


def test_bad_input_is_refused_with_the_way_out() -> None:
    with pytest.raises(ValueError, match="n_times=20: expected a multiple of 8 samples"):
        encoder(SMALL.encoder, 20, "encoder")
    with pytest.raises(ValueError, match="channels=3: expected an even number"):
        ReversibleConfig(channels=3)
    with pytest.raises(ValueError, match=r"depths=\(2,\): expected 2 whole numbers"):
        ReversibleConfig(depths=(2,))
    with pytest.raises(ValueError, match=r"squeezes=\(\): expected at least one stage"):
        ReversibleConfig(squeezes=(), depths=(), hidden=(), taps=())
    with pytest.raises(ValueError, match=r"gain=0.0: expected a number > 0"):
        ReversibleConfig(gain=0.0)
    tight = ReversibleConfig(squeezes=(8, 2))
    with pytest.raises(ValueError, match="channels=8: expected at least 16, the samples"):
        blocks.lift(dataclasses.replace(tight, squeezes=(16, 1)), jnp.zeros((1, 1, 16, 1)))


def test_multiply_adds_are_those_of_the_matrix_products() -> None:
    """Counted in the program, where the blocks of a stage are a scan."""
    params = export(init(jax.random.key(0), SMALL))
    program = jax.make_jaxpr(lambda p, x: predict(SMALL, p, x).logits)(params, X[:1])
    assert sum(multiply_adds(SMALL).values()) == dots(program.jaxpr)


def dots(jaxpr: jax.extend.core.Jaxpr) -> int:
    """Multiply-adds of all matrix products of a program, those of a scan in every step."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            inner = np.prod([equation.invars[0].aval.shape[i] for i in contracted])
            total += int(inner * np.prod(equation.outvars[0].aval.shape))
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for value in equation.params.values():
            inside = getattr(value, "jaxpr", value)
            if isinstance(inside, jax.extend.core.Jaxpr):
                total += times * dots(inside)
    return total
