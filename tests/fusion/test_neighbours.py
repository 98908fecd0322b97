"""Tables for scalar sensors and the head that compares with training rows, against numpy loops."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import Corruption, export, finish, fit, predict, random_failing, test_output
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data import from_arrays
from fusion.data.dataset import Dataset
from fusion.encoders import EncoderConfig, reading_levels
from fusion.neighbours import neighbour_probabilities
from fusion.tables import TableEncoder, codes, reading_ranks
from fusion.train import init_state, make_train

K, C = 4, 3


@pytest.fixture(scope="module")
def data() -> Dataset:
    """Scalars on a coarse grid; each class has its own mean in every sensor."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, C, 400)
    x = np.round(3.0 * rng.normal(size=(C, K))[y] + 2.0 * rng.normal(size=(400, K)))
    return from_arrays(x[:, :, None], y)


def rows(data: Dataset) -> tuple[jax.Array, jax.Array]:
    return jnp.asarray(data.train_x), jnp.asarray(data.train_y)


def network(data: Dataset, **changes: object) -> ModelConfig:
    levels = reading_levels(data.train_x)
    encoder = EncoderConfig(
        features=5, scalar="table", levels=levels, ranks=reading_ranks(data.train_x, levels)
    )
    config = ModelConfig(
        "argate_plus",
        n_sensors=K,
        n_times=1,
        n_classes=C,
        encoder=encoder,
        gate_width=8,
        head_widths=(8,),
        dropout=0.0,
        head="neighbourhood",
        memory_rows=64,
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def trained(data: Dataset):  # type: ignore[no-untyped-def]
    config = network(data)
    protocol = random_failing(data.channels, 2)
    noise, key = Corruption(protocol, protocol), jax.random.key(0)
    train = TrainConfig(epochs=6, batch_size=50)
    return config, noise, fit(config, train, HyperParams(1e-2), data, noise, key=key).state


def test_a_reading_finds_the_nearest_level_and_says_when_it_is_none() -> None:
    levels = ((-1.0, 0.0, 0.25), (0.5,))
    x = np.array([[-1.0, 0.1, 0.2, 9.0], [0.5, 0.5, -1.0, 0.500001]], np.float32)
    rows, unknown = codes(levels, jnp.asarray(x))
    for k, row in enumerate(levels):
        for i, value in enumerate(x[k]):
            distance = np.abs(np.asarray(row) - value)
            assert rows[k, i] == distance.argmin()
            assert unknown[k, i] == (distance.min() > 1e-5)


def test_neighbour_shares_agree_with_a_loop_over_rows() -> None:
    rng = np.random.default_rng(1)
    e, m = rng.normal(size=(K, 6, 2)), rng.normal(size=(K, 9, 2))
    w = rng.dirichlet(np.ones(K), 6)
    y, excluded = rng.integers(0, C, 9), rng.random((6, 9)) < 0.3
    given = (jnp.asarray(a, jnp.float32) for a in (e, w, m))
    found = neighbour_probabilities(
        *given, jnp.asarray(y), C, jnp.float32(0.7), excluded=jnp.asarray(excluded)
    )
    for i in range(6):
        shares = np.zeros(C)
        for j in range(9):
            if not excluded[i, j]:
                d = sum(K * w[i, k] * ((e[k, i] - m[k, j]) ** 2).sum() for k in range(K))
                shares[y[j]] += np.exp(-0.7 * d)
        np.testing.assert_allclose(found[i], shares / shares.sum(), rtol=2e-5)


@pytest.mark.parametrize(("examples", "known"), [(3, 5), (512, 1024), (530, 1030), (1, 2500)])
@pytest.mark.parametrize("far", [0.0, 40.0])
def test_shares_in_tiles_are_those_of_a_softmax_in_float64(
    examples: int, known: int, far: float
) -> None:
    """Also where every row in memory is so far away that its share alone would be zero."""
    rng = np.random.default_rng(2)
    e, m = (rng.normal(size=(K, n, 2)).astype(np.float32) for n in (examples, known))
    e += np.float32(far)
    w = rng.dirichlet(np.ones(K), examples).astype(np.float32)
    y = rng.integers(0, C, known)
    found = neighbour_probabilities(*map(jnp.asarray, (e, w, m, y)), C, jnp.float32(0.5))
    d = np.stack(
        [K * ((a[:, None].astype(np.float64) - m) ** 2).sum(-1) for a in e.transpose(1, 0, 2)]
    )
    score = -0.5 * np.einsum("bk,bkm->bm", w, d)
    share = np.exp(score - score.max(1, keepdims=True)) @ np.eye(C)[y]
    np.testing.assert_allclose(
        found, share / share.sum(1, keepdims=True), atol=2e-3 if far else 1e-5
    )


def test_a_sensor_of_weight_zero_has_no_influence() -> None:
    rng = np.random.default_rng(3)
    e, m = (jnp.asarray(rng.normal(size=(K, n, 2)), jnp.float32) for n in (5, 20))
    w = jnp.full((5, K), 1.0 / 3).at[:, 1].set(0.0)
    y = jnp.asarray(rng.integers(0, C, 20))
    one = neighbour_probabilities(e, w, m, y, C, jnp.float32(1.0))
    other = neighbour_probabilities(e.at[1].add(5.0), w, m, y, C, jnp.float32(1.0))
    assert np.array_equal(one, other)


def test_training_leaves_each_example_out_of_its_own_neighbours(data: Dataset) -> None:
    """With itself among the neighbours a sharp head would be right on every training row."""
    config = network(data, memory_rows=10_000)
    state = init_state(jax.random.key(0), config, TrainConfig(), rows(data))
    main = export(state.params)
    main = main | {"log_sharpness": jnp.float32(9.0)}
    rng = np.random.default_rng(0)
    order = state.params["memory"]["number"]
    assert sorted(order.tolist()) == list(range(len(data.train_y)))
    shuffled = main | {
        "memory": main["memory"]
        | {"labels": jnp.asarray(rng.permutation(main["memory"]["labels"]))}
    }
    excluded = jnp.arange(len(order))[:, None] == order[None, :]
    with_itself = predict(config, main, jnp.asarray(data.train_x)).logits.argmax(-1)
    without = predict(config, shuffled, jnp.asarray(data.train_x), excluded=excluded)
    assert (with_itself == data.train_y).mean() > 0.9
    assert (without.logits.argmax(-1) == data.train_y).mean() < 0.6


def test_an_unknown_reading_gives_the_token_and_the_flag_unless_switched_off(
    data: Dataset,
) -> None:
    levels = reading_levels(data.train_x)
    for known in (True, False):
        module = TableEncoder(levels, (), 5, known)
        x = jnp.asarray(data.train_x[:2]).transpose(1, 0, 2).at[0, 0, 0].add(1e-3)
        params = module.init(jax.random.key(0), x)
        features = module.apply(params, x)
        assert (float(features[0, 0, -1]) > 0.0) == known
        assert (float(jnp.abs(features[0, 0, :-1]).sum()) == 0.0) == known


@pytest.mark.slow
def test_a_trained_head_beats_the_largest_class_and_takes_absent_sensors(trained, data) -> None:  # type: ignore[no-untyped-def]
    config, noise, state = trained
    out = test_output(config, state, data, noise, key=jax.random.key(0))
    assert (out.logits.argmax(-1) == out.labels).mean() > 0.6
    x = jnp.asarray(data.test_x[:8])
    absent = predict(config, export(state.params), x.at[:, 2].set(jnp.nan))
    moved = predict(
        config, export(state.params), x, available=jnp.ones((8, K), bool).at[:, 2].set(False)
    )
    assert np.array_equal(absent.logits, moved.logits)
    assert float(absent.weights[:, 2].max()) == 0.0


def test_a_fitted_head_is_the_same_after_save_and_load(trained, data, tmp_path) -> None:  # type: ignore[no-untyped-def]
    config, noise, state = trained
    fitted = finish(config, state, data, noise, key=jax.random.key(1), false_alarm_rate=0.05)
    fitted.save(tmp_path / "net.npz")
    raw = data.scale.low[:, None] * np.ones((3, K, 1))
    again = type(fitted).load(tmp_path / "net.npz").predict(raw)
    assert np.array_equal(fitted.predict(raw).probabilities, again.probabilities)


@pytest.mark.relaxed  # optax
@pytest.mark.slow
def test_fit_and_make_train_draw_the_same_network(trained, data) -> None:  # type: ignore[no-untyped-def]
    config, noise, state = trained
    run = make_train(config, TrainConfig(epochs=6, batch_size=50), len(data.train_y), noise.train)
    hyper = jax.tree.map(jnp.float32, HyperParams(1e-2))
    x, y = jnp.asarray(data.train_x), jnp.asarray(data.train_y)
    other, _ = jax.jit(lambda key: run(hyper, x, y, key=key))(jax.random.key(0))
    table = ("main", "encoder", "table")
    one, two = state.params, other.params
    for name in table:
        one, two = one[name], two[name]
    np.testing.assert_allclose(one, two, atol=2e-4)


def test_a_neighbourhood_head_is_refused_where_it_cannot_be(data: Dataset) -> None:
    with pytest.raises(ValueError, match="head='neighbourhood'"):
        ModelConfig(head="neighbourhood")
    config = network(data)
    with pytest.raises(ValueError, match="clean=None"):
        init_state(jax.random.key(0), config, TrainConfig())
    state = init_state(jax.random.key(0), config, TrainConfig(), rows(data))
    with pytest.raises(ValueError, match="without a memory"):
        predict(config, state.params["main"], jnp.asarray(data.test_x))
