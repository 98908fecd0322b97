"""Record what snnTorch's `Leaky` does, for the neurons of `fusion.spiking`.

    pip install torch==2.13.0 snntorch==1.0.0     (in an environment of its own)
    python tests/reference/spiking_snntorch.py

writes `tests/golden/spiking_snntorch.npz`: random currents, and for both resets the spikes and
potentials of every step; for the hard reset also the gradients of a weighted sum of the spikes in
currents and leaks, for two surrogates. The currents keep potentials below two thresholds, where
snnTorch's soft reset without delay subtracts once, as ours does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import snntorch
import torch
from snntorch import surrogate

OUT = Path(__file__).resolve().parent.parent / "golden" / "spiking_snntorch.npz"
SURROGATES = {
    "fast_sigmoid": surrogate.fast_sigmoid(slope=4.0),
    "arctan": surrogate.atan(alpha=2.0),
}


def run(leak: torch.Tensor, current: torch.Tensor, reset: str, gradient: object) -> tuple:
    """Spikes and potentials after the reset of every step; the current is scaled by the leak."""
    mechanism = {"soft": "subtract", "hard": "zero"}[reset]
    # Only without the delay is the potential that is subtracted from not leaked first.
    cell = snntorch.Leaky(
        beta=1.0 - leak,
        reset_mechanism=mechanism,
        spike_grad=gradient,
        reset_delay=reset == "hard",
    )
    mem, spikes, potentials = torch.zeros_like(current[0]), [], []
    for row in current:
        fired, mem = cell(leak * row, mem)
        spikes.append(fired)
        potentials.append(mem)
    return torch.stack(spikes), torch.stack(potentials)


def main() -> None:
    """Draw, run, write."""
    rng = np.random.default_rng(7)
    leak = rng.uniform(0.15, 0.9, 6).astype(np.float32)
    current = rng.uniform(-0.5, 1.9, (50, 4, 6)).astype(np.float32)
    weight = rng.normal(size=(50, 4, 6)).astype(np.float32)
    found = {"leak": leak, "current": current, "weight": weight}
    for reset in ("soft", "hard"):
        spikes, potentials = run(
            torch.tensor(leak), torch.tensor(current), reset, SURROGATES["fast_sigmoid"]
        )
        found[f"{reset}_spikes"] = spikes.detach().numpy()
        found[f"{reset}_potentials"] = potentials.detach().numpy()
    for name, gradient in SURROGATES.items():
        inputs = [torch.tensor(a, requires_grad=True) for a in (leak, current)]
        spikes, _ = run(*inputs, "hard", gradient)
        (spikes * torch.tensor(weight)).sum().backward()
        found[f"{name}_leak"], found[f"{name}_current"] = (a.grad.numpy() for a in inputs)
    found["versions"] = np.array([f"snntorch {snntorch.__version__}", f"torch {torch.__version__}"])
    np.savez_compressed(OUT, **found)


if __name__ == "__main__":
    main()
