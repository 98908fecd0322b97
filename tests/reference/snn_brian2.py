"""Record one second of a small S3 / S4 network in Brian 2, for `test_brian2_parity.py`.

    python tests/reference/snn_brian2.py       (needs brian2 >= 2.9 with numpy < 2.3; half a minute)

Same equations, same order within a step, same injected input spikes and rewards as
`jaxsnn.network.step`; Brian computes in float64. Writes `tests/golden/snn_brian2.npz`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).resolve().parent.parent / "golden" / "snn_brian2.npz"
N_IN, N_HIDDEN, N_OUT, STEPS = 42, 16, 2, 1000
DT = 1e-3
LIF = {"tau_m": 20e-3, "v_rest": 0.0, "v_reset": 0.0, "v_th": 15.0, "t_ref": 2e-3}
STDP = {"a_plus": 1.0, "a_minus": -1.0, "tau_plus": 20e-3, "tau_minus": 20e-3, "tau_z": 25e-3}
W_MAX, GAMMA = 5.0, 0.02
GAIN_INPUT, GAIN_OUTPUT = 4.0, 3.0


def drive(seed: int) -> dict[str, np.ndarray]:
    """Input spikes, initial magnitudes, signs and a reward that changes every 100 ms."""
    rng = np.random.default_rng(seed)
    sign_pre = np.tile(np.repeat([1.0, -1.0], [3, 3]), 7)
    sign_hidden = np.tile(np.repeat([1.0, -1.0], [4, 4]), 2)
    return {
        "pre": (rng.random((STEPS, N_IN)) < 0.06),
        "w_hidden": rng.uniform(0, W_MAX, (N_IN, N_HIDDEN)),
        "w_output": rng.uniform(0, W_MAX, (2, N_HIDDEN // 2)),
        "reward": np.repeat(rng.uniform(-2, 2, (STEPS // 100, 2)), 100, axis=0),
        "sign_pre": sign_pre,
        "sign_hidden": sign_hidden,
    }


def simulate(rule: str, data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The network in Brian 2: potentials, spikes, final weights, traces and eligibility."""
    import brian2 as b2

    b2.start_scope()
    b2.prefs.codegen.target = "numpy"
    b2.defaultclock.dt = DT * b2.second
    membrane = "dv/dt = (v_rest - v)/tau_m : 1 (unless refractory)"
    space = {
        "v_rest": LIF["v_rest"],
        "v_reset": LIF["v_reset"],
        "v_th": LIF["v_th"],
        "tau_m": LIF["tau_m"] * b2.second,
        "tau_plus": STDP["tau_plus"] * b2.second,
        "tau_minus": STDP["tau_minus"] * b2.second,
        "tau_z": STDP["tau_z"] * b2.second,
        "tau_z_s": STDP["tau_z"],
        "a_plus": STDP["a_plus"],
        "a_minus": STDP["a_minus"],
        "gamma_dt": GAMMA * DT,
        "w_max": W_MAX,
    }

    def layer(n: int) -> b2.NeuronGroup:
        group = b2.NeuronGroup(
            n,
            membrane,
            threshold="v > v_th",
            reset="v = v_reset",
            refractory=LIF["t_ref"] * b2.second,
            method="euler",
            namespace=space,
        )
        group.v = LIF["v_rest"]
        return group

    when, which = np.nonzero(data["pre"])
    inputs = b2.SpikeGeneratorGroup(N_IN, which, when * DT * b2.second)
    hidden, output = layer(N_HIDDEN), layer(N_OUT)
    rewards = b2.TimedArray(data["reward"], dt=DT * b2.second, name="rewards")
    space["rewards"] = rewards

    def project(source: object, target: object, gain: float) -> b2.Synapses:
        synapses = b2.Synapses(
            source,
            target,
            """w : 1
            dale : 1 (constant)
            credit : 1 (constant)
            motor : integer (constant)
            dz/dt = -z/tau_z : 1 (clock-driven)
            dp_plus/dt = -p_plus/tau_plus : 1 (clock-driven)
            dp_minus/dt = -p_minus/tau_minus : 1 (clock-driven)""",
            on_pre={
                "drive": "v_post += gain*dale*w",
                "trace": "p_plus += a_plus",
                "pair": "z += p_minus/tau_z_s",
            },
            on_post={"trace_post": "p_minus += a_minus", "pair_post": "z += p_plus/tau_z_s"},
            method="exact",
            namespace={**space, "gain": gain},
        )
        # Both traces take the spikes of the step before any pair is counted.
        synapses.trace.order = synapses.trace_post.order = 0
        synapses.drive.order = 1
        synapses.pair.order = synapses.pair_post.order = 2
        amount = "gamma_dt*credit*rewards(t, motor)*z"
        rule_code = {"additive": f"w + {amount}", "multiplicative": f"w*exp({amount})"}[rule]
        synapses.run_regularly(f"w = clip({rule_code}, 0, w_max)", when="end")
        return synapses

    half = N_HIDDEN // 2
    first = project(inputs, hidden, GAIN_INPUT)
    first.connect()
    i, j = np.array(first.i), np.array(first.j)
    first.w = data["w_hidden"][i, j]
    first.dale = data["sign_pre"][i]
    first.credit = data["sign_pre"][i] * data["sign_hidden"][j]
    first.motor = j // half
    second = project(hidden, output, GAIN_OUTPUT)
    second.connect(i=np.arange(N_HIDDEN), j=np.arange(N_HIDDEN) // half)
    i2, j2 = np.array(second.i), np.array(second.j)
    second.w = data["w_output"].ravel()[i2]
    second.dale = data["sign_hidden"][i2]
    second.credit = data["sign_hidden"][i2]
    second.motor = j2

    spikes_hidden, spikes_output = b2.SpikeMonitor(hidden), b2.SpikeMonitor(output)
    v_hidden = b2.StateMonitor(hidden, "v", record=True, when="end")
    v_output = b2.StateMonitor(output, "v", record=True, when="end")
    network = b2.Network(
        inputs, hidden, output, first, second, spikes_hidden, spikes_output, v_hidden, v_output
    )
    network.run(STEPS * DT * b2.second)

    def raster(monitor: b2.SpikeMonitor, n: int) -> np.ndarray:
        out = np.zeros((STEPS, n), bool)
        out[np.round(np.array(monitor.t) / DT).astype(int), np.array(monitor.i)] = True
        return out

    def dense(values: object) -> np.ndarray:
        out = np.zeros((N_IN, N_HIDDEN))
        out[i, j] = np.array(values)
        return out

    return {
        "v_hidden": np.array(v_hidden.v).T[:, ::4].astype(np.float32),
        "v_output": np.array(v_output.v).T.astype(np.float32),
        "spikes_hidden": raster(spikes_hidden, N_HIDDEN),
        "spikes_output": raster(spikes_output, N_OUT),
        "w_hidden": dense(first.w),
        "w_output": np.array(second.w).reshape(2, half),
        "z_hidden": dense(first.z),
        "z_output": np.array(second.z).reshape(2, half),
    }


def main() -> None:
    """Record both rules with the versions that made them."""
    import brian2

    data = drive(seed=2017)
    out: dict[str, np.ndarray] = {f"in_{k}": v for k, v in data.items()}
    for rule in ("additive", "multiplicative"):
        for name, value in simulate(rule, data).items():
            out[f"{rule}_{name}"] = value
    out["versions"] = np.array(f"brian2 {brian2.__version__}, numpy {np.__version__}")
    GOLDEN.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(GOLDEN, **out)
    print(f"result: file={GOLDEN.name} bytes={GOLDEN.stat().st_size}")


if __name__ == "__main__":
    main()
