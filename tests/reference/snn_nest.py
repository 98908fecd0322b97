"""Record neurons of `jaxsnn.declared` in NEST, for `test_declared_nest.py`.

    python tests/reference/snn_nest.py    (nest-simulator >= 3.8 with numpy < 2.3; seconds)

The exact LIF neuron of NEST (`iaf_psc_delta`) with its refractory time, and Izhikevich's neuron by
Euler steps and by those of his paper (`izhikevich`, `consistent_integration`), under currents, in
float64. Writes `tests/golden/snn_nest.npz`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).resolve().parent.parent / "golden" / "snn_nest.npz"
STEPS, EVERY = 300, 5
LIF = {"tau_m": 20e-3, "v_rest": -2.0, "v_reset": -1.0, "v_th": 15.0, "resistance": 1.5}
T_REF, LIF_DT = 2e-3, 0.5e-3
LIF_CURRENT = np.array([11.5, 12.0, 15.0, 21.0, 40.0])
CELLS = {
    "regular": {"a": 0.02, "b": 0.2, "c": -65.0, "d": 8.0},
    "chattering": {"a": 0.02, "b": 0.2, "c": -50.0, "d": 2.0},
    "fast": {"a": 0.1, "b": 0.2, "c": -65.0, "d": 2.0},
}
# Weak ones: under strong ones rounding grows tenfold with every few spikes.
CELL_CURRENT = np.array([4.5, 5.0, 5.5])
CELL_DT = 1e-3


def run(model: str, constants: dict, currents: np.ndarray, dt: float) -> dict[str, np.ndarray]:
    """Spikes `[STEPS, n]` and every fifth potential `[STEPS / 5, n]` under held currents."""
    import nest

    nest.ResetKernel()
    nest.set_verbosity("M_ERROR")
    ms = 1e3 * dt
    nest.resolution = ms
    cells = nest.Create(model, len(currents), params=constants)
    cells.I_e = currents.tolist()
    meter = nest.Create("multimeter", params={"record_from": ["V_m"], "interval": ms})
    spikes = nest.Create("spike_recorder")
    nest.Connect(meter, cells)
    nest.Connect(cells, spikes)
    nest.Simulate((STEPS + 1) * ms)
    first = min(cells.tolist())
    seen = meter.events
    v = np.zeros((STEPS, len(currents)))
    step = np.round(seen["times"] / ms).astype(int) - 1  # the potential after step 0 is at dt
    v[step, seen["senders"] - first] = seen["V_m"]
    raster = np.zeros((STEPS, len(currents)), bool)
    when = np.round(spikes.events["times"] / ms).astype(int) - 1
    kept = when < STEPS
    raster[when[kept], spikes.events["senders"][kept] - first] = True
    return {"spikes": raster, "v": v[::EVERY]}


def record() -> dict[str, np.ndarray]:
    """All recordings, by name."""
    found = {}
    membrane = {
        "tau_m": 1e3 * LIF["tau_m"],
        # R I = I tau_m / C_m, in mV for pA, ms and pF.
        "C_m": 1e3 * LIF["tau_m"] / LIF["resistance"],
        "E_L": LIF["v_rest"],
        "V_reset": LIF["v_reset"],
        "V_th": LIF["v_th"],
        "V_m": LIF["v_rest"],
        # NEST counts the steps after that of the spike; Brian 2 and jaxsnn count that one, too.
        "t_ref": 1e3 * (T_REF - LIF_DT),
    }
    cases = {"lif": ("iaf_psc_delta", membrane, LIF_CURRENT, LIF_DT)}
    for name, constants in CELLS.items():
        for method, consistent in (("euler", True), ("paper", False)):
            begin = {"V_m": constants["c"], "U_m": constants["b"] * constants["c"]}
            space = {**constants, **begin, "V_th": 30.0, "consistent_integration": consistent}
            cases[f"{name}_{method}"] = "izhikevich", space, CELL_CURRENT, CELL_DT
    for name, case in cases.items():
        for what, values in run(*case).items():
            found[f"{name}_{what}"] = values
    return found


if __name__ == "__main__":
    np.savez_compressed(GOLDEN, **record())
