"""The PyTorch comparison: the peers are the same network, and the ratios are what they say."""

from __future__ import annotations

import sys

import pytest

from tests._scripts import load_script

bench_fusion = load_script("benchmarks/bench_fusion")


def test_ratios_are_taken_turn_by_turn() -> None:
    speeds = {
        "ours": [100.0, 300.0],
        "ours_conv_backend": [10.0, 100.0],
        "ours_argate_l": [50.0, 200.0],
        "torch_loop": [50.0, 100.0],
        "torch_grouped": [25.0, 200.0],
    }
    found = bench_fusion.ratios(speeds)
    assert found["ours/torch_loop"] == [2.0, 3.0]
    assert found["ours/torch_grouped"] == [4.0, 1.5]
    assert found["ours/faster torch"] == [2.0, 1.5]
    assert found["matmul/conv backend"] == [10.0, 3.0]
    assert found["cost argate_l/baseline"] == [2.0, 1.5]


def test_without_torch_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ValueError, match=r"pip install -e '\.\[bench\]'"):
        bench_fusion.import_torch()


@pytest.mark.slow
@pytest.mark.relaxed
def test_the_peers_are_the_same_network() -> None:
    pytest.importorskip("torch")
    import jax

    from fusion.presets import preset

    data = bench_fusion._synthetic(320, 0)
    found = bench_fusion.parity(preset(data, "baseline"), data, jax.random.key(1))
    assert set(found) == set(bench_fusion.PEERS)
    assert all(difference["logits"] < 1e-4 for difference in found.values())
