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
        "torch_compiled": [40.0, 240.0],
    }
    found = bench_fusion.ratios(speeds)
    assert found["ours/torch_loop"] == [2.0, 3.0]
    assert found["ours/torch_grouped"] == [4.0, 1.5]
    assert found["ours/torch_compiled"] == [2.5, 1.25]
    assert found["ours/fastest torch"] == [2.0, 1.25]
    assert found["matmul/conv backend"] == [10.0, 3.0]
    assert found["cost argate_l/baseline"] == [2.0, 1.5]
    # Where nothing can be compiled, the others are compared all the same.
    del speeds["torch_compiled"]
    found = bench_fusion.ratios(speeds)
    assert found["ours/fastest torch"] == [2.0, 1.5] and "ours/torch_compiled" not in found


def test_without_torch_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ValueError, match=r"pip install -e '\.\[bench\]'"):
        bench_fusion.import_torch()


def test_a_machine_that_cannot_compile_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")

    def refuse(*_: object) -> None:
        raise RuntimeError("No working C++ compiler found in CXX\nand a long trace")

    monkeypatch.setattr(torch, "compile", lambda call: refuse)
    found = bench_fusion.load_peer().compile_problem()
    assert found is not None
    assert "RuntimeError: No working C++ compiler found in CXX; install a C++" in found


@pytest.mark.slow
@pytest.mark.relaxed
def test_the_peers_are_the_same_network() -> None:
    pytest.importorskip("torch")
    import jax

    from fusion.presets import preset

    data = bench_fusion._synthetic(320, 0)
    peers = bench_fusion.PEERS
    if bench_fusion.load_peer().compile_problem():
        peers = tuple(peer for peer in peers if peer != "torch_compiled")
    found = bench_fusion.parity(preset(data, "baseline"), data, jax.random.key(1), peers=peers)
    assert set(found) == set(peers)
    assert all(difference["logits"] < 1e-4 for difference in found.values())
