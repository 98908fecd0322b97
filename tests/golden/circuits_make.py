"""Record the specifications of a few samples: `python tests/golden/circuits_make.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from failure import circuits

N = 8


def main() -> None:
    """Write `circuits_ldo.json` beside this file."""
    x = np.random.default_rng(7).normal(size=(N, 60))
    x[0] = 0.0
    x[-1] = 3.0 * np.sign(x[-1])
    specs, status = circuits.get("ldo").simulate(x)
    record = {"specs": np.asarray(specs).tolist(), "status": np.asarray(status).tolist()}
    path = Path(__file__).parent / "circuits_ldo.json"
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
