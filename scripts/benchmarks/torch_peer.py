"""The late-fusion HAR network in PyTorch, twice: as a user would write it, and with grouped layers.

Both compute what `fusion.models.FusionNet` computes for `model="baseline"`; `load_parameters`
copies the parameters of one into the other, so that the benchmark can show it. `compile_problem`
tells whether `torch.compile` can build programs here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional


def _basis(n: int) -> Tensor:
    """Hann-windowed cosine and sine columns, as `fusion.encoders` has them."""
    angle = 2.0 * np.pi * np.outer(np.arange(n), np.arange(1, n // 2 + 1)) / n
    window = np.hanning(n)[:, None] * 2.0 / n
    columns = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) * window
    return torch.from_numpy(columns.astype(np.float32))


def _spectral(x: Tensor, basis: Tensor) -> Tensor:
    """Log power spectrum and moments over the last axis."""
    mean = x.mean(-1, keepdim=True)
    centred = x - mean
    cosine, sine = (centred @ basis).chunk(2, -1)
    sd = ((centred**2).mean(-1, keepdim=True) + 1e-8).sqrt()
    step = ((x.diff(dim=-1) ** 2).mean(-1, keepdim=True) + 1e-8).sqrt()
    parts = [
        0.25 * torch.log(cosine**2 + sine**2 + 1e-6) + 1.5,
        3.0 * mean,
        3.0 * mean**2,
        torch.log(sd) + 2.0,
        x.amax(-1, keepdim=True),
        x.amin(-1, keepdim=True),
        5.0 * step,
        5.0 * centred.abs().mean(-1, keepdim=True),
    ]
    return torch.cat(parts, -1)


class _Head(nn.Module):
    """Dropout, hidden layer, dropout, logits."""

    def __init__(self, n_inputs: int, width: int, n_classes: int, dropout: float) -> None:
        super().__init__()
        self.dropout = nn.Dropout(dropout)
        self.hidden = nn.Linear(n_inputs, width)
        self.logits = nn.Linear(width, n_classes)

    def forward(self, h: Tensor) -> Tensor:
        h = torch.relu(self.hidden(self.dropout(h)))
        return self.logits(self.dropout(h))


class _Branch(nn.Module):
    """One sensor: two convolutions beside the spectrum, then a dense layer."""

    basis: Tensor

    def __init__(self, config: Any) -> None:
        super().__init__()
        encoder = config.encoder
        (c0, c1), (k0, k1), (s0, s1) = (
            encoder.conv_features,
            encoder.conv_kernels,
            encoder.conv_strides,
        )
        self.conv0 = nn.Conv1d(1, c0, k0, stride=s0)
        self.conv1 = nn.Conv1d(c0, c1, k1, stride=s1)
        self.conv_out = nn.Linear(2 * c1, encoder.features)
        self.spectral = nn.Linear(config.n_times // 2 + 7, encoder.features)
        self.out = nn.Linear(2 * encoder.features, encoder.features)
        self.register_buffer("basis", _basis(config.n_times))

    def forward(self, x: Tensor) -> Tensor:
        """Class logits."""
        h = 5.0 * (x - x.mean(-1, keepdim=True))[:, None, :]
        h = torch.relu(self.conv1(torch.relu(self.conv0(h))))
        h = torch.cat([h.mean(-1), h.amax(-1)], -1)
        paths = [self.conv_out(h), self.spectral(_spectral(x, self.basis))]
        return torch.relu(self.out(torch.relu(torch.cat(paths, -1))))


class LoopNet(nn.Module):
    """A module per sensor, called in a loop: what a user would write."""

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.branches = nn.ModuleList(_Branch(config) for _ in range(config.n_sensors))
        n_inputs = config.n_sensors * config.encoder.features
        self.head = _Head(n_inputs, config.head_widths[0], config.n_classes, config.dropout)

    def forward(self, x: Tensor) -> Tensor:
        """Class logits."""
        features = [branch(x[:, k]) for k, branch in enumerate(self.branches)]
        return self.head(torch.cat(features, -1))


class GroupedNet(nn.Module):
    """All sensors at once: grouped convolutions and batched matrix products."""

    basis: Tensor

    def __init__(self, config: Any) -> None:
        super().__init__()
        encoder, k = config.encoder, config.n_sensors
        (c0, c1), (k0, k1), (s0, s1) = (
            encoder.conv_features,
            encoder.conv_kernels,
            encoder.conv_strides,
        )
        self.conv0 = nn.Conv1d(k, k * c0, k0, stride=s0, groups=k)
        self.conv1 = nn.Conv1d(k * c0, k * c1, k1, stride=s1, groups=k)
        sizes = {
            "conv_out": 2 * c1,
            "spectral": config.n_times // 2 + 7,
            "out": 2 * encoder.features,
        }
        self.kernels = nn.ParameterDict(
            {name: torch.randn(k, n, encoder.features) / n**0.5 for name, n in sizes.items()}
        )
        self.biases = nn.ParameterDict(
            {name: torch.zeros(k, 1, encoder.features) for name in sizes}
        )
        n_inputs = k * encoder.features
        self.head = _Head(n_inputs, config.head_widths[0], config.n_classes, config.dropout)
        self.register_buffer("basis", _basis(config.n_times))

    def _dense(self, name: str, x: Tensor) -> Tensor:
        return torch.baddbmm(self.biases[name], x, self.kernels[name])

    def forward(self, x: Tensor) -> Tensor:
        """Class logits."""
        b, k, _ = x.shape
        h = torch.relu(self.conv0(5.0 * (x - x.mean(-1, keepdim=True))))
        h = torch.relu(self.conv1(h))
        h = torch.cat([z.view(b, k, -1) for z in (h.mean(-1), h.amax(-1))], -1)
        spectrum = _spectral(x, self.basis)
        paths = [
            self._dense("conv_out", h.transpose(0, 1)),
            self._dense("spectral", spectrum.transpose(0, 1)),
        ]
        features = torch.relu(self._dense("out", torch.relu(torch.cat(paths, -1))))
        return self.head(features.transpose(0, 1).reshape(b, -1))


def load_parameters(net: LoopNet | GroupedNet, main: dict[str, Any]) -> None:
    """Copy the parameters of `fusion.models.init(...)["main"]` into a peer."""

    def copy(target: Tensor, value: Any) -> None:
        target.copy_(torch.from_numpy(np.array(value)).reshape(target.shape))

    encoder = {name: np.asarray(value) for name, value in main["encoder"].items()}
    with torch.no_grad():
        for layer, name in ((net.head.hidden, "head0"), (net.head.logits, "head1")):
            copy(layer.weight, np.asarray(main[name]["kernel"]).T)
            copy(layer.bias, main[name]["bias"])
        for name in ("conv0", "conv1"):
            # [branch, width, channel, feature] -> [branch, feature, channel, width]
            kernel = encoder[f"{name}_kernel"].transpose(0, 3, 2, 1)
            bias = encoder[f"{name}_bias"]
            if isinstance(net, GroupedNet):
                copy(getattr(net, name).weight, kernel.reshape(-1, *kernel.shape[2:]))
                copy(getattr(net, name).bias, bias.reshape(-1))
                continue
            for k, branch in enumerate(net.branches):
                copy(getattr(branch, name).weight, kernel[k])
                copy(getattr(branch, name).bias, bias[k])
        for name in ("conv_out", "spectral", "out"):
            kernel, bias = encoder[f"{name}_kernel"], encoder[f"{name}_bias"]
            if isinstance(net, GroupedNet):
                copy(net.kernels[name], kernel)
                copy(net.biases[name], bias)
                continue
            for k, branch in enumerate(net.branches):
                copy(getattr(branch, name).weight, kernel[k].T)
                copy(getattr(branch, name).bias, bias[k])


def compile_problem() -> str | None:
    """Why `torch.compile` cannot build a program on this machine; None where it can.

    On a CPU it writes C++ and needs a compiler; the least program shows whether all is there.
    """
    try:
        torch.compile(lambda x: torch.sin(x) + 1.0)(torch.zeros(4))
    except (
        Exception
    ) as error:  # its backends fail in many ways: no compiler, headers, another Python
        first = next((line for line in str(error).splitlines() if line.strip()), "no reason given")
        return (
            f"torch.compile failed with {type(error).__name__}: {first.strip()}; install a C++ "
            "compiler and the headers of this Python, or set CXX"
        )
    return None


def train_epoch(
    net: nn.Module,
    optimizer: torch.optim.Optimizer,
    config: Any,
    terms: Any,
    rate: Callable[[int], float],
) -> Callable[[Tensor, Tensor], float]:
    """Build `epoch(x, y) -> mean loss`: shuffled batches, clipping, decoupled weight decay.

    Args:
        net, optimizer: to train; the optimizer is `torch.optim.AdamW`.
        config: a `fusion.config.TrainConfig`; terms: a `fusion.loss_config.LossConfig`.
        rate: learning rate of a step.
    """
    step = 0

    def epoch(x: Tensor, y: Tensor) -> float:
        nonlocal step
        n_batches = len(x) // config.batch_size
        order = torch.randperm(len(x))[: n_batches * config.batch_size]
        total = torch.zeros(())
        for index in order.view(n_batches, config.batch_size):
            for group in optimizer.param_groups:
                group["lr"] = rate(step)
            loss = functional.cross_entropy(
                net(x[index]), y[index], label_smoothing=terms.label_smoothing
            )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), config.clip_norm)
            optimizer.step()
            total += loss.detach()
            step += 1
        return float(total) / n_batches

    return epoch
