"""Speed of Brian 2 on the S4 network in a closed loop; prints one line of JSON.

    python tests/reference/snn_brian2_speed.py [--ms 3000] [--control 50] [--target cython]

210 Poisson inputs, 208 hidden and 2 motor neurons, additive reward-modulated STDP with clocked
eligibility traces on all synapses; a `network_operation` every control step reads the motors and
sets rates and reward, as a robot's loop would. `scripts/benchmarks/bench_snn.py --brian2-python`
calls this file with an interpreter that has brian2 >= 2.9 and numpy < 2.3.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np


def main() -> None:
    """Build, compile, warm up, time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ms", type=int, default=3000)
    parser.add_argument("--control", type=int, default=50)
    parser.add_argument("--target", default="cython")
    args = parser.parse_args()
    import brian2 as b2

    b2.prefs.codegen.target = args.target
    ms = b2.ms
    b2.defaultclock.dt = 1 * ms
    b2.seed(0)
    rng = np.random.default_rng(0)
    space = {"tau_m": 20 * ms, "tau_p": 20 * ms, "tau_z": 25 * ms, "gamma": 1e-5, "w_max": 5.0}
    neuron = "dv/dt = -v/tau_m : 1 (unless refractory)"
    kwargs = {"threshold": "v > 15", "reset": "v = 0", "refractory": 2 * ms, "method": "euler"}
    inputs = b2.PoissonGroup(210, rates=np.full(210, 35.0) * b2.Hz)
    hidden = b2.NeuronGroup(208, neuron, namespace=space, **kwargs)
    motors = b2.NeuronGroup(2, neuron, namespace=space, **kwargs)

    def project(source: object, target: object) -> b2.Synapses:
        return b2.Synapses(
            source,
            target,
            """w : 1
            dale : 1 (constant)
            reward : 1 (shared)
            dz/dt = -z/tau_z : 1 (clock-driven)
            dp_plus/dt = -p_plus/tau_p : 1 (event-driven)
            dp_minus/dt = -p_minus/tau_p : 1 (event-driven)""",
            on_pre="v_post += dale*w\np_plus += 1\nz += p_minus",
            on_post="p_minus -= 1\nz += p_plus",
            method="exact",
            namespace=space,
        )

    first, second = project(inputs, hidden), project(hidden, motors)
    first.connect()
    second.connect(i=np.arange(208), j=np.arange(208) // 104)
    for synapses, n in ((first, 210), (second, 208)):
        synapses.w = rng.uniform(0, 5, len(synapses))
        synapses.dale = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[np.array(synapses.i)]
        synapses.run_regularly("w = clip(w + gamma*reward*z, 0, w_max)", dt=1 * ms)
    counter = b2.SpikeMonitor(motors, record=False)
    everything = b2.SpikeMonitor(hidden, record=False)
    last = np.zeros(2)

    @b2.network_operation(dt=args.control * ms)
    def robot() -> None:
        count = np.array(counter.count)
        turn = float((count - last) @ [-1.0, 1.0])
        last[:] = count
        first.reward = second.reward = 1.0 if turn > 0 else -1.0
        inputs.rates = (35.0 + 5.0 * np.sign(turn)) * b2.Hz

    network = b2.Network(
        inputs, hidden, motors, first, second, counter, everything, robot, *first.contained_objects,
        *second.contained_objects,
    )  # fmt: skip
    network.run(2 * args.control * ms)
    before, spikes = time.process_time(), everything.num_spikes
    network.run(args.ms * ms)
    seconds = time.process_time() - before
    rate = (everything.num_spikes - spikes) / 208 / (args.ms * 1e-3)
    print(
        json.dumps(
            {
                "robot_ms_per_s": args.ms / seconds,
                "hidden_hz": rate,
                "target": args.target,
                "brian2": b2.__version__,
            }
        )
    )


if __name__ == "__main__":
    main()
