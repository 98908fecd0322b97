"""Training throughput of the HAR network against the same network in PyTorch, on one CPU thread.

    pip install -e '.[bench]'
    python scripts/benchmarks/bench_fusion.py --record

Takes about five minutes on one core. For batches of 16 and 128 it prints samples per CPU-second of
both, and ratios: ours over PyTorch (written as a module per sensor, with grouped layers, and these
through `torch.compile`), our two convolution backends inside `jax.lax.scan`, and what a step of
ARGate-L costs over one of the baseline. `torch.compile` builds C++, outside the timing; where it
cannot, the run says why and goes on with the others. All contenders take turns within one run and
the median ratio of the turns counts, so that a busy machine slows them alike; CPU time of the
process is measured, not wall time. Before the timing the networks get the same parameters, and must
give the same logits and the same losses over training steps. The last line is `result: ...` with
the ratios.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    provenance,
    repository,
    run_command,
    write_json,
)
from snn_fusion_failure.runs.one_core import pin
from snn_fusion_failure.runs.origin import check_recordable

PEERS = ("torch_loop", "torch_grouped", "torch_compiled")
TARGETS = {16: 2.0, 128: 1.3}
"""The least ratio of ours over the fastest PyTorch version, by batch size."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare the training throughput with PyTorch."""

    batch_sizes: tuple[int, ...] = (16, 128)
    blocks: int = 7
    """Turns; in each, every contender trains one epoch."""
    examples: int = 1024
    """Synthetic windows per epoch (a quarter of them for the slow conv backend)."""
    core: int | None = None
    """CPU to run on; the first that is allowed when left out."""
    seed: int = 0
    record: bool = False
    """Write results/bench_fusion.json."""
    out: Path | None = None
    """Folder for `result.json`."""


def import_torch() -> Any:
    """PyTorch with one thread, or an error that says how to get it."""
    try:
        import torch
    except ImportError:
        raise ValueError(
            "the comparison needs PyTorch, which is not installed: pip install -e '.[bench]'"
        ) from None
    torch.set_num_threads(1)
    return torch


def load_peer() -> Any:
    """The module `torch_peer.py` beside this file; scripts are files, not a package."""
    import importlib.util
    import sys

    name = "bench_fusion_torch_peer"
    if name not in sys.modules:
        path = Path(__file__).with_name("torch_peer.py")
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def _synthetic(n: int, seed: int) -> Any:
    """A data set with the sizes of HAR; the values do not matter for the time of a step."""
    import numpy as np

    from fusion.data.dataset import Dataset, Scale

    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (n, 9, 128)).astype(np.float32)
    y = rng.integers(0, 6, n).astype(np.int32)
    group = np.zeros(n, np.int32)
    channels = tuple(f"channel_{k}" for k in range(9))
    classes = tuple(f"class_{c}" for c in range(6))
    scale = Scale(-np.ones(9), np.ones(9))
    return Dataset("har", x, y, x[:8], y[:8], group, group[:8], channels, classes, "random", scale)


def _ours(settings: Any, n: int, data: Any, key: Any) -> Callable[[], None]:
    """An epoch of ours as a call without arguments; compiled here, outside the timing."""
    import jax
    import jax.numpy as jnp

    from fusion.train import init_state, make_epoch

    model, config, hyper = settings
    x, y = jnp.asarray(data.train_x[:n]), jnp.asarray(data.train_y[:n])
    failed = jnp.zeros(x.shape[:2], bool)
    hyper = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hyper)
    epoch = jax.jit(make_epoch(model, config, n))
    state, turn = init_state(key, model, config), 0

    def run() -> None:
        nonlocal state, turn
        turn += 1
        state, metrics = epoch(hyper, state, x, y, failed, key=jax.random.fold_in(key, turn))
        jax.block_until_ready((state, metrics))

    run()
    return run


def _schedule(config: Any, hyper: Any, n: int) -> Callable[[int], float]:
    """The cosine of `fusion.train` for PyTorch's loop."""
    import math

    total = config.epochs * (n // config.batch_size)
    return lambda step: hyper.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1, step / total)))


def _theirs(kind: str, settings: Any, n: int, data: Any, main: Any) -> Callable[[], None]:
    """An epoch of PyTorch as a call without arguments."""
    import torch

    torch_peer = load_peer()
    model, config, hyper = settings
    net, optimizer = _peer(kind, model, hyper, main)
    x, y = torch.from_numpy(data.train_x[:n]), torch.from_numpy(data.train_y[:n]).long()
    rate = _schedule(config, hyper, n)
    epoch = torch_peer.train_epoch(net, optimizer, config, model.recipe.loss, rate)

    def run() -> None:
        epoch(x, y)

    run()
    return run


def _peer(kind: str, model: Any, hyper: Any, main: Any) -> tuple[Any, Any]:
    """A PyTorch network with our parameters, and its optimizer (fused but for the loop)."""
    import torch

    torch_peer = load_peer()
    made = torch_peer.LoopNet if kind == "torch_loop" else torch_peer.GroupedNet
    net = made(model)
    torch_peer.load_parameters(net, main)
    optimizer = torch.optim.AdamW(
        net.parameters(),
        lr=hyper.learning_rate,
        weight_decay=hyper.weight_decay,
        fused=None if kind == "torch_loop" else True,
    )
    return torch.compile(net, dynamic=False) if kind == "torch_compiled" else net, optimizer


def parity(
    settings: Any, data: Any, key: Any, *, steps: int = 5, peers: Sequence[str] = PEERS
) -> dict[str, dict[str, float]]:
    """Show that the peers are the same network: largest differences of logits and of losses.

    The losses are those of `steps` training steps without dropout on the same batches, so that
    gradients, clipping, Adam, decay and schedule are compared too.

    Raises:
        ValueError: logits differ by more than 1e-4, or losses by more than 1e-3.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np
    import torch
    from torch.nn import functional

    from fusion.models import init, predict
    from fusion.train import init_state, train_step

    model, config, hyper = settings
    model = dataclasses.replace(model, dropout=0.0)
    rate = _schedule(config, hyper, len(data.train_x))
    state = init_state(key, model, config)
    main = init(key, model)["main"]
    batches = [slice(64 * i, 64 * (i + 1)) for i in range(steps)]
    x, y = data.train_x, data.train_y
    ours_logits = np.asarray(predict(model, main, jnp.asarray(x[:64])).logits)
    hyper = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hyper)
    step = jax.jit(lambda *a: train_step(model, config, hyper, *a, key=key))
    losses = []
    for i, batch in enumerate(batches):
        failed = jnp.zeros(x[batch].shape[:2], bool)
        state, metrics = step(
            state, jnp.float32(rate(i)), jnp.asarray(x[batch]), jnp.asarray(y[batch]), failed
        )
        losses.append(float(metrics.loss.total))
    found: dict[str, dict[str, float]] = {}
    for kind in peers:
        net, optimizer = _peer(kind, model, settings.hyper, main)
        # With gradients, as in training: one more program to compile otherwise.
        logits = net(torch.from_numpy(x[:64])).detach().numpy()
        theirs = []
        for i, batch in enumerate(batches):
            for group in optimizer.param_groups:
                group["lr"] = rate(i)
            loss = functional.cross_entropy(
                net(torch.from_numpy(x[batch])),
                torch.from_numpy(y[batch]).long(),
                label_smoothing=model.recipe.loss.label_smoothing,
            )
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip_norm)
            optimizer.step()
            theirs.append(float(loss.detach()))
        n_parameters = sum(p.numel() for p in net.parameters())
        if n_parameters != sum(leaf.size for leaf in jax.tree.leaves(main)):
            raise ValueError(f"{kind} has {n_parameters} parameters, which is not our number")
        found[kind] = {
            "logits": float(np.abs(logits - ours_logits).max()),
            "losses": float(np.abs(np.subtract(theirs, losses)).max()),
        }
        if found[kind]["logits"] > 1e-4 or found[kind]["losses"] > 1e-3:
            raise ValueError(f"{kind} is not the same network: differences {found[kind]}")
    return found


def contenders(
    config: Config, batch_size: int, data: Any, peers: Sequence[str]
) -> dict[str, tuple[int, Any]]:
    """Name -> (samples of an epoch, call that trains one)."""
    import jax

    from fusion.models import init
    from fusion.presets import preset

    key = jax.random.key(config.seed)
    n = config.examples
    few = max(batch_size, n // 4)
    made: dict[str, tuple[int, Any]] = {}
    for name, model_name, backend, size in (
        ("ours", "baseline", "matmul", n),
        ("ours_conv_backend", "baseline", "conv", few),
        ("ours_argate_l", "argate_l", "matmul", n),
    ):
        settings = preset(data, model_name)
        model = dataclasses.replace(
            settings.model, encoder=dataclasses.replace(settings.model.encoder, backend=backend)
        )
        train = dataclasses.replace(settings.train, batch_size=batch_size)
        made[name] = (size, _ours((model, train, settings.hyper), size, data, key))
    settings = preset(data, "baseline")
    settings = settings._replace(train=dataclasses.replace(settings.train, batch_size=batch_size))
    main = init(key, settings.model)["main"]
    for kind in peers:
        made[kind] = (n, _theirs(kind, settings, n, data, main))
    return {name: (size - size % batch_size, run) for name, (size, run) in made.items()}


def measure(
    config: Config, batch_size: int, data: Any, peers: Sequence[str]
) -> dict[str, list[float]]:
    """Samples per CPU-second of every contender, one value per turn."""
    speeds: dict[str, list[float]] = {}
    runs = contenders(config, batch_size, data, peers)
    for _ in range(config.blocks):
        for name, (samples, run) in runs.items():
            start = time.process_time()
            run()
            speeds.setdefault(name, []).append(samples / (time.process_time() - start))
    return speeds


def ratios(speeds: dict[str, list[float]]) -> dict[str, list[float]]:
    """The ratios that are reported, one value per turn."""

    def over(a: str, b: str) -> list[float]:
        return [x / y for x, y in zip(speeds[a], speeds[b], strict=True)]

    # What a user chooses is the fastest of them; it may differ from turn to turn.
    peers = [peer for peer in PEERS if peer in speeds]
    best = [max(turn) for turn in zip(*(speeds[peer] for peer in peers), strict=True)]
    return {
        **{f"ours/{peer}": over("ours", peer) for peer in peers},
        "ours/fastest torch": [x / y for x, y in zip(speeds["ours"], best, strict=True)],
        "matmul/conv backend": over("ours", "ours_conv_backend"),
        "cost argate_l/baseline": over("ours", "ours_argate_l"),
    }


def _row(batch_size: int, model: str, metric: str, unit: str, values: list[float]) -> dict:
    summary = summarize(values)
    return {
        "row": f"batch {batch_size}",
        "model": model,
        "metric": metric,
        "unit": unit,
        **summary,
        "median": statistics.median(values),
    }


def main(config: Config) -> dict[str, Any]:
    """Check, time, print; returns what results/bench_fusion.json holds."""
    if config.record:
        check_recordable()
    core = pin(config.core)
    torch = import_torch()
    enable_compilation_cache()
    import jax

    from fusion.presets import preset

    torch.manual_seed(config.seed)
    data = _synthetic(config.examples, config.seed)
    peers, left_out = list(PEERS), {}
    if problem := load_peer().compile_problem():
        peers.remove("torch_compiled")
        left_out["torch_compiled"] = problem
        print(f"torch_compiled is left out: {problem}", flush=True)
    key = jax.random.key(config.seed)
    same = parity(preset(data, "baseline"), data, key, peers=peers)
    for kind, found in same.items():
        print(f"{kind:14s} same network: logits within {found['logits']:.1e}, losses of training "
              f"steps within {found['losses']:.1e}", flush=True)  # fmt: skip
    rows: list[dict[str, Any]] = []
    summary: dict[str, float] = {}
    for batch_size in config.batch_sizes:
        speeds = measure(config, batch_size, data, peers)
        for name, values in speeds.items():
            rows.append(_row(batch_size, name, "throughput", "samples per CPU-second", values))
            print(f"batch {batch_size:4d}  {name:18s} {statistics.median(values):8.0f} samples per "
                  "CPU-second", flush=True)  # fmt: skip
        by_name = ratios(speeds)
        for name, values in by_name.items():
            rows.append(_row(batch_size, name, "ratio", "1", values))
            wanted = TARGETS.get(batch_size) if name == "ours/fastest torch" else None
            if wanted is not None:
                rows[-1]["target"] = wanted
            note = "" if wanted is None else f"  (wanted: at least {wanted:g})"
            print(f"batch {batch_size:4d}  {name:24s} {statistics.median(values):6.2f}{note}",
                  flush=True)  # fmt: skip
        summary[f"ratio_batch_{batch_size}"] = statistics.median(by_name["ours/fastest torch"])
    record = {
        "table": "bench_fusion",
        "title": "Training throughput on one CPU thread beside PyTorch",
        "preset": "paper",
        **provenance(),
        "core": core,
        "parity": same,
        "rows": rows,
    }
    if left_out:
        record["left_out"] = left_out
    record["versions"] = {**record["versions"], "torch": str(torch.__version__)}
    if config.record:
        write_json(repository.RESULTS / "bench_fusion.json", record)
    if config.out is not None:
        write_json(config.out / "result.json", record)
    print_result(**summary)
    return record


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
