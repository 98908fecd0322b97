"""Record each model of `jaxsnn.declared` in Brian 2, for `test_declared_brian2.py`.

    python tests/reference/snn_models_brian2.py    (brian2 >= 2.9 with numpy < 2.3; half a minute)

Three networks with injected input spikes, in float64: neurons (with delays and a recurrent
table), receptors and short-term plasticity, and learning rules. Writes
`tests/golden/snn_models_brian2.npz`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).resolve().parent.parent / "golden" / "snn_models_brian2.npz"
DT, STEPS, N_IN, N_OUT, EVERY = 0.5e-3, 1000, 20, 6, 5
LIF = {"tau_m": 20e-3, "v_rest": -2.0, "v_reset": -1.0, "v_th": 15.0, "resistance": 1.5}
T_REF = {"euler": 2e-3, "exact": 2.9e-3, "adaptive": 1e-3}
ADAPTIVE = {"tau_theta": 80e-3, "theta_jump": 3.0}
IZHIKEVICH = {"a": 0.02, "b": 0.2, "c": -65.0, "d": 8.0, "v_peak": 30.0}
TAU_SYN = {"current": 5e-3, "excite": 4e-3, "inhibit": 8e-3}
REVERSAL = {"excite": 60.0, "inhibit": -15.0}
SHORT = {"use": 0.3, "tau_f": 0.4, "tau_d": 0.15}
PAIR = {"a_plus": 0.05, "a_minus": -0.06, "tau_plus": 15e-3, "tau_minus": 25e-3}
SHARE = {**PAIR, "a_plus": 0.02, "a_minus": -0.03}
TRIPLET = {
    "a2_plus": 0.01, "a3_plus": 0.03, "a2_minus": 0.03, "a3_minus": 0.02,
    "tau_plus": 16.8e-3, "tau_x": 101e-3, "tau_minus": 33.7e-3, "tau_y": 125e-3,
}  # fmt: skip
REWARD = {
    "a_plus": 1.0, "a_minus": -1.0, "tau_plus": 20e-3, "tau_minus": 20e-3, "tau_z": 25e-3,
    "gamma": 0.1,
}  # fmt: skip
W_MAX, TEACHER = 3.0, 20.0
RULES = ("pair", "pair_soft", "triplet", "reward_soft", "reward_times")


def drive(seed: int) -> dict[str, np.ndarray]:
    """Spikes, weights, delays, currents and a reward that changes every 50 ms."""
    rng = np.random.default_rng(seed)
    shape = (N_IN, N_OUT)
    return {
        "pre": rng.random((STEPS, N_IN)) < 0.03,
        "teacher": rng.random((STEPS, N_OUT)) < 0.015,
        "sign": np.where(np.arange(N_IN) < 14, 1.0, -1.0),
        "weight": rng.uniform(0, W_MAX, shape),
        "weight_back": rng.uniform(0, 2.0, (N_OUT, N_OUT)),
        "table": rng.random((N_OUT, N_OUT)) < 0.5,
        "delay": rng.integers(1, 9, shape),
        "delay_axon": rng.integers(1, 6, N_IN),
        "current": rng.uniform(4, 9, N_OUT),
        "reward": np.repeat(rng.uniform(-2, 2, (STEPS // 100, N_OUT)), 100, axis=0),
    }


class Recorder:
    """A Brian 2 network that grows by parts and gives back what its groups did."""

    def __init__(self, data: dict[str, np.ndarray]) -> None:
        import brian2 as b2

        self.b2, self.data = b2, data
        b2.start_scope()
        b2.prefs.codegen.target = "numpy"
        b2.defaultclock.dt = DT * b2.second
        self.parts: list = []
        self.watched: dict = {}

    def source(self, spikes: np.ndarray) -> object:
        """Injected spikes."""
        when, which = np.nonzero(spikes)
        group = self.b2.SpikeGeneratorGroup(spikes.shape[1], which, when * DT * self.b2.second)
        self.parts.append(group)
        return group

    def group(self, name: str, equations: str, method: str, space: dict, **how: object) -> object:
        """Neurons, watched."""
        group = self.b2.NeuronGroup(
            N_OUT, equations, method=method, namespace=self.seconds(space), **how
        )
        monitors = (
            self.b2.SpikeMonitor(group),
            self.b2.StateMonitor(group, "v", record=True, when="end"),
        )
        self.parts += [group, *monitors]
        self.watched[name] = monitors
        return group

    def lif(
        self, name: str, method: str, t_ref: float, current: np.ndarray, more: str = ""
    ) -> object:
        """Leaky integrate-and-fire; `more` is added to what drives the membrane."""
        group = self.group(
            name,
            f"dv/dt = (v_rest - v + resistance*(I_ext {more}))/tau_m : 1 (unless refractory)\n"
            "I_ext : 1 (constant)\n"
            + ("dI/dt = -I/tau_current : 1\ndg/dt = -g/tau_excite : 1\n" if more else "")
            + ("dh/dt = -h/tau_inhibit : 1\n" if more else ""),
            method,
            {**LIF, **{f"tau_{k}": v for k, v in TAU_SYN.items()}},
            threshold="v > v_th",
            reset="v = v_reset",
            refractory=t_ref * self.b2.second,
        )
        group.v, group.I_ext = LIF["v_rest"], current
        return group

    def seconds(self, space: dict) -> dict:
        """Time constants with their unit."""
        return {k: v * self.b2.second if k.startswith("tau") else v for k, v in space.items()}

    def connect(
        self, source: object, target: object, weight: np.ndarray, code: str,
        delay: object = 1, table: np.ndarray | None = None, sign: np.ndarray | None = None,
    ) -> object:  # fmt: skip
        """Synapses without learning; a delay of one step of ours is none of Brian's."""
        made = self.b2.Synapses(source, target, "w : 1\ndale : 1", on_pre=code)
        here = np.ones(weight.shape, bool) if table is None else table
        i, j = np.nonzero(here)
        made.connect(i=i, j=j)
        made.w, made.dale = weight[i, j], 1.0 if sign is None else sign[i]
        made.pre.delay = (np.broadcast_to(delay, weight.shape)[i, j] - 1) * DT * self.b2.second
        self.parts.append(made)
        return made

    def run(self) -> dict[str, np.ndarray]:
        """Spikes [T, n] and every fifth potential of each group."""
        self.b2.Network(*self.parts).run(STEPS * DT * self.b2.second)
        out = {}
        for name, (spikes, v) in self.watched.items():
            raster = np.zeros((STEPS, N_OUT), bool)
            raster[np.round(np.array(spikes.t) / DT).astype(int), np.array(spikes.i)] = True
            out[f"{name}_spikes"] = raster
            out[f"{name}_v"] = np.array(v.v).T[::EVERY]
        return out


def neurons(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Four models behind the same delayed edges; the first projects back to the second."""
    r = Recorder(data)
    source = r.source(data["pre"])
    groups = {
        "euler": r.lif("euler", "euler", T_REF["euler"], data["current"]),
        "exact": r.lif("exact", "exact", T_REF["exact"], data["current"]),
        "adaptive": r.group(
            "adaptive",
            "dv/dt = (v_rest - v + resistance*I_ext)/tau_m : 1 (unless refractory)\n"
            "dtheta/dt = -theta/tau_theta : 1\nI_ext : 1 (constant)",
            "exact",
            {**LIF, **ADAPTIVE},
            threshold="v > v_th + theta",
            reset="v = v_reset\ntheta += theta_jump",
            refractory=T_REF["adaptive"] * r.b2.second,
        ),
        "izhikevich": r.group(
            "izhikevich",
            "dv/dt = (0.04*v**2 + 5*v + 140 - u + I_ext)/tau_ms : 1\n"
            "du/dt = a*(b*v - u)/tau_ms : 1\nI_ext : 1 (constant)",
            "euler",
            {**IZHIKEVICH, "tau_ms": 1e-3},
            threshold="v >= v_peak",
            reset="v = c\nu += d",
        ),
    }
    groups["adaptive"].v = LIF["v_rest"]
    groups["izhikevich"].v, groups["izhikevich"].u = IZHIKEVICH["c"], -13.0
    for name in ("adaptive", "izhikevich"):
        groups[name].I_ext = data["current"]
    for group in groups.values():
        r.connect(
            source, group, data["weight"], "v_post += dale*w", data["delay"], sign=data["sign"]
        )
    back = data["weight_back"], "v_post += dale*w"
    r.connect(groups["euler"], groups["exact"], *back, table=data["table"])
    r.connect(groups["exact"], groups["exact"], *back, 4)
    return r.run()


def receptors(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A current and two conductances on one group; short-term plasticity on another."""
    r = Recorder(data)
    source = r.source(data["pre"])
    zero = np.zeros(N_OUT)
    more = f"+ I + g*({REVERSAL['excite']} - v) + h*({REVERSAL['inhibit']} - v)"
    group = r.lif("receptors", "exponential_euler", T_REF["euler"], zero, more)
    r.connect(source, group, data["weight"], "I_post += dale*w", data["delay_axon"][:, None],
              sign=data["sign"])  # fmt: skip
    r.connect(source, group, 0.15 * data["weight"], "g_post += w", 2)
    r.connect(source, group, 0.03 * data["weight"], "h_post += w", data["delay"])
    tired = r.lif("short_term", "exact", T_REF["euler"], zero)
    made = r.b2.Synapses(
        source,
        tired,
        """w : 1
        du/dt = -u/tau_f : 1 (clock-driven)
        dx/dt = (1 - x)/tau_d : 1 (clock-driven)""",
        on_pre="u += use*(1 - u)\nv_post += 6*w*u*x\nx -= u*x",
        method="exact",
        namespace=r.seconds(SHORT),
    )
    made.connect()
    i, j = np.array(made.i), np.array(made.j)
    made.w, made.x = data["weight"][i, j], 1.0
    made.pre.delay = (data["delay_axon"][i] - 1) * DT * r.b2.second
    r.parts.append(made)
    out = r.run()
    first = [np.flatnonzero(i == n)[0] for n in range(N_IN)]
    return {**out, "short_u": np.array(made.u)[first], "short_x": np.array(made.x)[first]}


PAIR_EQUATIONS = """w : 1
    change : 1
    dp_plus/dt = -p_plus/tau_plus : 1 (clock-driven)
    dp_minus/dt = -p_minus/tau_minus : 1 (clock-driven)"""
# Both changes of a step are added before the weight is cut at its bounds.
CLIPPED = "w = clip(w + change, 0, w_max)\nchange = 0"
TIMES = "w*exp({0})"
ADD_SOFT = "(w_max - (w_max - w)*exp(-clip({0}, 0, inf)/w_max))*exp(clip({0}, -inf, 0)/w_max)"
LOGIT = "w*exp({0})/(1 + w/w_max*(exp({0}) - 1))"


def _rule(name: str) -> tuple[dict, str, dict, dict, str]:
    """Constants, equations, code at pre and at post spikes, and what `end` does to the weight."""
    traces = {"trace": "p_plus += a_plus"}, {"trace_post": "p_minus += a_minus"}
    if name in ("pair", "pair_soft"):
        return (
            PAIR if name == "pair" else SHARE,
            PAIR_EQUATIONS,
            {**traces[0], "pair": "change += p_minus"},
            {**traces[1], "pair_post": "change += p_plus"},
            CLIPPED if name == "pair" else f"w = {LOGIT.format('change')}\nchange = 0",
        )
    if name == "triplet":
        return (
            TRIPLET,
            """w : 1
            change : 1
            dp_plus/dt = -p_plus/tau_plus : 1 (clock-driven)
            dr2/dt = -r2/tau_x : 1 (clock-driven)
            dp_minus/dt = -p_minus/tau_minus : 1 (clock-driven)
            do2/dt = -o2/tau_y : 1 (clock-driven)""",
            {
                "trace": "p_plus += 1",
                "pair": "change -= p_minus*(a2_minus + a3_minus*r2)",
                "slow": "r2 += 1",
            },
            {
                "trace_post": "p_minus += 1",
                "pair_post": "change += p_plus*(a2_plus + a3_plus*o2)",
                "slow_post": "o2 += 1",
            },
            CLIPPED,
        )
    amount = "(gamma*dt_s*rewards(t, j)*z)"
    how = {"reward_soft": ADD_SOFT, "reward_times": f"clip({TIMES}, 0, w_max)"}[name]
    return (
        REWARD,
        PAIR_EQUATIONS + "\n    dz/dt = -z/tau_z : 1 (clock-driven)",
        {**traces[0], "pair": "z += p_minus/tau_z_s"},
        {**traces[1], "pair_post": "z += p_plus/tau_z_s"},
        f"w = {how.format(amount)}",
    )


def rules(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """One group per rule, driven by a teacher and through the weights that learn."""
    r = Recorder(data)
    source, teacher = r.source(data["pre"]), r.source(data["teacher"])
    rewards = r.b2.TimedArray(data["reward"], dt=DT * r.b2.second, name="rewards")
    made = {}
    for name in RULES:
        group = r.lif(name, "euler", T_REF["euler"], np.zeros(N_OUT))
        r.connect(teacher, group, TEACHER * np.eye(N_OUT), "v_post += w", table=np.eye(N_OUT) > 0)
        space, equations, at_pre, at_post, end = _rule(name)
        # In code for spikes Brian takes a bare number where `z` has no unit.
        more = {"w_max": W_MAX, "tau_z_s": REWARD["tau_z"], "dt_s": DT, "rewards": rewards}
        synapses = r.b2.Synapses(
            source,
            group,
            equations,
            on_pre={"drive": "v_post += w", **at_pre},
            on_post=at_post,
            method="exact",
            namespace={**r.seconds(space), **more},
        )
        # Traces take the spikes of a step before pairs are counted; slow ones come last.
        for path in (*at_pre, *at_post, "drive"):
            kind = path.removesuffix("_post")
            order = {"trace": 0, "drive": 1, "pair": 2, "slow": 3}[kind]
            getattr(synapses, path).order = order
        synapses.connect()
        i, j = np.array(synapses.i), np.array(synapses.j)
        synapses.w = data["weight"][i, j]
        delay = {"pair": data["delay"], "triplet": data["delay_axon"][:, None]}.get(name, 3)
        for path in ("drive", *at_pre):
            steps = np.broadcast_to(delay, data["weight"].shape)[i, j] - 1
            getattr(synapses, path).delay = steps * DT * r.b2.second
        synapses.run_regularly(end, when="end")
        r.parts.append(synapses)
        made[name] = synapses
    out = r.run()
    for name, synapses in made.items():
        table = np.zeros((N_IN, N_OUT))
        table[np.array(synapses.i), np.array(synapses.j)] = np.array(synapses.w)
        out[f"{name}_w"] = table
    return out


def main() -> None:
    """Record the three networks with the versions that made them."""
    import brian2

    data = drive(seed=1307)
    out = {f"in_{name}": value for name, value in data.items()}
    for network in (neurons, receptors, rules):
        out |= network(data)
    out["versions"] = np.array(f"brian2 {brian2.__version__}, numpy {np.__version__}")
    np.savez_compressed(GOLDEN, **out)
    print(f"result: file={GOLDEN.name} bytes={GOLDEN.stat().st_size}")


if __name__ == "__main__":
    main()
