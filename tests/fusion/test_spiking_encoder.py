"""Spiking encoders: streaming to the bit, models and presets with them, learning rules, cost."""

from __future__ import annotations

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import HyperParams, ModelConfig, export, predict, preset
from fusion.config import MODELS
from fusion.data import load
from fusion.encoders import EncoderConfig, encoder
from fusion.losses import LossConfig
from fusion.models import init
from fusion.presets import ENCODED, recipe_and_encoder
from fusion.spiking import operations
from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import draw_stack
from fusion.spiking.encoder import run_encoder, stack_params
from fusion.spiking.layers import feed, readout, stack_start
from fusion.spiking.reward_stdp import reward_term
from fusion.train import batch_loss

SPIKING = SpikingConfig(widths=(6, 5), taps=(4, 3), strides=(2, 2))
SMALL = ModelConfig(
    "argate_l",
    n_sensors=2,
    n_times=16,
    n_classes=3,
    encoder=EncoderConfig(series="spiking", spiking=SPIKING),
    gate_width=4,
    head_widths=(8,),
    dropout=0.0,
)
X = jax.random.uniform(jax.random.key(1), (7, 2, 16), minval=-1.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"recurrent": True, "adaptation": 0.3},
        {"code": "latency", "reset": "hard"},
        {"code": "delta", "readout": "both"},
        {"code": "rate", "learn_tau": False},
        {"code": "contrast", "slow": 5.0},
        {"resonance": (0.05, 0.3), "read": "all", "readout": "membranes"},
    ],
)
def test_a_window_in_pieces_gives_the_bits_of_one_call(changes: dict) -> None:
    config = dataclasses.replace(SPIKING, stepwise=True, threshold=0.4, **changes)
    layers = draw_stack(config, 2, key=jax.random.key(0))
    x = jnp.transpose(X, (1, 0, 2))
    fed = jax.jit(lambda state, piece: feed(config, layers, state, piece)[0])
    start = stack_start(config, 2, 7)
    whole, state = fed(start, x), start
    for piece in (x[..., :4], x[..., 4:12], x[..., 12:]):
        state = fed(state, piece)
    chex.assert_trees_all_equal(state, whole)
    assert float(jnp.sum(readout(config, whole) > 0)) > 5
    at_once = dataclasses.replace(config, stepwise=False)
    feature = readout(config, feed(at_once, layers, start, x)[0])
    np.testing.assert_allclose(feature, readout(config, whole), atol=1e-4)


def test_a_piece_that_ends_within_a_step_is_refused() -> None:
    layers = draw_stack(SPIKING, 2, key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"inputs.shape\[0\]=6: expected a multiple of 4"):
        feed(SPIKING, layers, stack_start(SPIKING, 2, 7), jnp.zeros((2, 7, 6)))
    with pytest.raises(ValueError, match="n_times=18: expected a multiple of 4 samples"):
        encoder(SMALL.encoder, 18, "encoder")


@pytest.mark.parametrize(
    "model",
    [
        "argate_l", "embracenet", pytest.param("baseline", marks=pytest.mark.slow),
        pytest.param("oracle", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_any_recipe_takes_the_spiking_encoder(model: str) -> None:
    config = dataclasses.replace(SMALL, model=model)
    params = init(jax.random.key(0), config)
    told = jnp.zeros((7, 2), bool) if config.reads_failed else None
    out = jax.jit(lambda main: predict(config, main, X, told))(export(params))
    assert out.features.shape == (2, 7, 5)
    assert bool(jnp.all(jnp.isfinite(out.logits)))


def test_gradients_reach_every_part_of_the_encoder_and_fixed_ones_none() -> None:
    labels, failed = jnp.arange(7) % 3, jnp.zeros((7, 2), bool)
    recurrent = dataclasses.replace(SPIKING, recurrent=True, tau=(2.0, 6.0))

    def slopes(learning: str) -> dict:
        spiking = dataclasses.replace(recurrent, learning=learning)
        config = dataclasses.replace(
            SMALL, encoder=dataclasses.replace(SMALL.encoder, spiking=spiking)
        )
        params = init(jax.random.key(0), config)

        def loss(p: dict) -> jax.Array:
            return batch_loss(config, HyperParams(), p, X, labels, failed)[0]

        found = jax.jit(jax.grad(loss))(params)
        return jax.tree.map(lambda g: float(jnp.abs(g).max()), found["main"]["encoder"])

    trained, fixed, told = (slopes(rule) for rule in ("surrogate", "fixed", "reward_stdp"))
    assert set(trained) >= {"layer0_kernel", "layer0_leak", "layer1_bias", "layer1_back"}
    assert min(trained.values()) > 0.0
    assert max(fixed.values()) == 0.0
    assert {name for name, slope in told.items() if slope} == {"layer0_kernel", "layer1_kernel"}


def test_the_reward_term_is_the_three_factor_rule() -> None:
    config = dataclasses.replace(SPIKING, code="delta", tau_stdp=3.0, stdp_rate=2.0)
    layers = draw_stack(config, 2, key=jax.random.key(3))
    flat = {f"layer{i}_{n}": v for i, own in enumerate(layers) for n, v in own.items()}
    x = jnp.transpose(X, (1, 0, 2))
    losses = jax.random.uniform(jax.random.key(5), (7, 2))
    found = jax.grad(lambda p: reward_term(config, p, x, losses))(flat)
    activity = run_encoder(config, flat, x)[1]
    decay, wanted = math.exp(-1 / 3.0), np.asarray(losses)
    for layer in range(2):
        inputs, spikes = (np.asarray(a[layer]) for a in (activity.columns, activity.spikes))
        n = len(spikes)
        expected = np.zeros(flat[f"layer{layer}_kernel"].shape)
        for t in range(n):
            for u in range(n):
                # An input at u, a spike at t: before it strengthens, after it weakens.
                pair = np.einsum("kbj,kbf->kbjf", inputs[u], spikes[t])
                sign = decay ** (t - u) if u <= t else -(decay ** (u - t))
                value = wanted - wanted.mean(0)
                expected += sign * np.einsum("bk,kbjf->kjf", value, pair) / n
        expected *= 2.0 / 7
        np.testing.assert_allclose(found[f"layer{layer}_kernel"], expected, atol=1e-5)
        assert np.abs(expected).max() > 1e-3


def test_reward_needs_auxiliary_paths() -> None:
    spiking = dataclasses.replace(SPIKING, learning="reward_stdp")
    reward = dataclasses.replace(SMALL.encoder, spiking=spiking)
    with pytest.raises(ValueError, match="learning='reward_stdp': expected a model with auxiliary"):
        dataclasses.replace(SMALL, model="netgated", encoder=reward)


def dots(jaxpr: jax.extend.core.Jaxpr) -> int:
    """Multiply-adds of all matrix products of a program."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            inner = math.prod(equation.invars[0].aval.shape[i] for i in contracted)
            total += math.prod(equation.outvars[0].aval.shape) * inner
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda v: hasattr(v, "jaxpr")
        ):
            if hasattr(value, "jaxpr"):
                total += dots(value.jaxpr) * equation.params.get("length", 1)
    return total


@pytest.mark.parametrize(
    "config",
    [
        ModelConfig(),
        ModelConfig("baseline", n_sensors=4, n_times=1, n_classes=3),
        dataclasses.replace(SMALL, encoder=EncoderConfig(features=7, conv_kernels=(3, 2))),
    ],
)
def test_multiply_adds_are_those_of_the_traced_program(config: ModelConfig) -> None:
    main = jax.eval_shape(lambda key: init(key, config)["main"], jax.random.key(0))
    x = jax.ShapeDtypeStruct((1, config.n_sensors, config.n_times), jnp.float32)
    traced = jax.make_jaxpr(lambda m, x: predict(config, m, x).logits)(main, x)
    assert sum(operations.multiply_adds(config).values()) == dots(traced.jaxpr)


def test_synaptic_operations_are_counted_spike_by_spike() -> None:
    spiking = dataclasses.replace(SPIKING, recurrent=True)
    config = dataclasses.replace(SMALL, encoder=dataclasses.replace(SMALL.encoder, spiking=spiking))
    main = init(jax.random.key(0), config)["main"]
    found = operations.cost(config, main, X, batch=4)
    activity = run_encoder(spiking, main["encoder"], jnp.transpose(X, (1, 0, 2)))[1]
    first, last = (np.asarray(s) for s in activity.spikes)
    adds = 0
    for t in range(len(first)):
        # Layer 1 has three taps and stride two over eight steps: who hears step t?
        heard = sum(0 <= 2 * (i + 1) - 1 - t < 3 for i in range(len(last)))
        adds += first[t].sum() * heard * 5
    adds += last.sum() * 5
    assert found.synaptic_operations == pytest.approx(adds / 7)
    assert found.spikes == pytest.approx((first.sum() + last.sum()) / 7)
    # Two sensors: 8 steps x 4 taps x 6 neurons, then 8 x 6 and 4 x 5 leaks; gate; head.
    products = 2 * (8 * 4 * 6 + 8 * 6 + 4 * 5) + 4 * (10 + 2) + 10 * 8 + 8 * 3
    assert found.multiply_adds == products
    assert found.energy == pytest.approx(1e-3 * (4.6 * products + 0.9 * adds / 7))


def test_names_mean_a_recipe_and_an_encoder() -> None:
    data = load("simulated")
    for name, (recipe, kind) in ENCODED.items():
        made = preset(data, name, "quick").model
        assert (made.model, made.encoder.series) == (recipe, kind)
    assert preset(data, "oracle", "quick", encoder="spiking").model.encoder.series == "spiking"
    assert {recipe_and_encoder(m) for m in MODELS} == {(m, "conv") for m in MODELS}
    with pytest.raises(ValueError, match="encoder='conv': expected 'spiking', which 'spiking_arg"):
        preset(data, "spiking_argate", encoder="conv")
    with pytest.raises(ValueError, match="did you mean 'spiking_argate'"):
        preset(data, "spiking_argat")


def test_scalars_are_held_for_the_steps() -> None:
    """A constant current: the first spike of a neuron comes where the closed form has it."""
    spiking = SpikingConfig(widths=(4,), taps=(1,), strides=(1,), steps=12, learn_tau=False)
    module = encoder(EncoderConfig(series="spiking", spiking=spiking), 1, "encoder")
    x = jnp.array([[[0.3], [-0.8]]])
    variables = module.init(jax.random.key(2), x)
    own = stack_params(spiking, variables["params"])[0]
    phi = module.expand(x)
    current = np.asarray(phi @ own["kernel"] + own["bias"][:, None])[0]
    activity = run_encoder(spiking, variables["params"], x, expand=module.expand)[1]
    fired = np.asarray(activity.spikes[0])[:, 0]
    tau = np.geomspace(1.2, 8.0, 4)
    for b, f in np.ndindex(2, 4):
        first = fired[:, b, f].argmax() if fired[:, b, f].any() else None
        i = current[b, f]
        # v(n) = I (1 - (1 - 1/tau)^n) exceeds one first at step n, counted from one.
        steps = math.log(1 - 1 / i) / math.log(1 - 1 / tau[f]) if i > 1 else math.inf
        assert first == (math.floor(steps) if steps < 12 else None)
    assert fired.any()


def test_the_loss_config_of_a_reward_model_is_its_recipes() -> None:
    spiking = dataclasses.replace(SPIKING, learning="reward_stdp")
    reward = dataclasses.replace(SMALL.encoder, spiking=spiking)
    off = LossConfig(
        auxiliary=False, loss_weighting=False, regularization=False, learned_targets=False
    )
    with pytest.raises(ValueError, match="auxiliary"):
        dataclasses.replace(SMALL, encoder=reward, loss=off)
