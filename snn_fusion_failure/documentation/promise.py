"""What is promised: packages with public names, their tasks, and what the page says of it."""

from __future__ import annotations

PACKAGES = {
    "jaxsnn": "Spiking robots",
    "fusion": "Sensor fusion",
    "fusion.lattice": "Lattices",
    "fusion.detection": "Detection on KITTI",
    "failure": "Rare failures",
    "snn_fusion_failure.sweeps": "Sweeps",
    "snn_fusion_failure.runs": "Runs",
}
"""Package whose `__all__` is public -> what it is about."""

BY_PATH = {
    "jaxsnn.brax_env": "robots as environments of brax, and what brax needs to run them",
    "jaxsnn.declared": "networks from populations and projections",
    "jaxsnn.declared_agent": "such a network as the driver of a robot",
    "jaxsnn.drivers": "drivers that do not learn, for comparison",
    "jaxsnn.encoding": "firing rates from the readings of a robot",
    "jaxsnn.families": "maps by family and split, their difficulty",
    "jaxsnn.map_files": "maps from files",
    "jaxsnn.navigation": "the robot as a task for PPO, and for learners written for gymnax",
    "jaxsnn.ppo": "proximal policy optimisation",
    "jaxsnn.plots": "pictures (matplotlib)",
    "jaxsnn.rewards": "rewards of a control step",
    "fusion.failure_odds": "which sensors have failed, for kinds never trained on, too",
    "fusion.uncertainty": "fusion weights with intervals, and windows that are left unanswered",
    "fusion.data.fixed": "the failing sensors that the source prints",
    "fusion.estimator": "ARGate with the face of scikit-learn",
    "fusion.modules": "ARGate and its loss around flax modules of one's own",
    "fusion.targets": "what ARGate-L learns its targets with",
    "fusion.plots": "pictures (matplotlib)",
    "fusion.reversible.blocks": "reversible trunks of series and images, and their inverse",
    "fusion.reversible.restoration": "windows of a failed sensor out of those of the others",
    "fusion.spiking.config": "neurons, codes and layers of spiking encoders",
    "fusion.spiking.encoder": "spiking encoders of whole windows",
    "fusion.spiking.layers": "spiking layers that are fed piece by piece",
    "fusion.spiking.operations": "operations and energy of an inference",
    "fusion.spiking.exchange": "spiking encoders as NIR graphs",
    "fusion.lattice.aggregation": "functions of sets of items",
    "fusion.lattice.plots": "pictures (matplotlib)",
    "fusion.lattice.premade": "calibrated models as functions",
    "fusion.lattice.ragged": "sets of unequal size as arrays",
    "fusion.detection.kitti": "files of KITTI and the official score",
    "fusion.detection.learning.stablehlo": "detectors as programs that need jax alone",
    "fusion.detection.plots": "pictures (matplotlib)",
    "failure.rev_argate": "Rev-ARGate (brings the fusion package along)",
    "failure.revnet": "invertible networks",
    "failure.hlrf": "the most likely failure point, by gradients",
    "failure.lines": "line sampling",
    "failure.performances": "a performance with its slopes",
    "failure.regions": "probability over several failure regions",
    "failure.yield_analysis": "yield of a circuit with several specifications",
    "failure.simulators": "netlists of one's own: decks, variations, limits, corners",
    "failure.plots": "pictures (matplotlib)",
    "snn_fusion_failure.commands.train_snn": "the command that trains robots, called from Python",
}
"""Module that the documentation shows by its full path -> what it is for; not promised."""

TASKS = {
    "jaxsnn.neurons": "Neurons, synapses and spikes",
    "jaxsnn.plasticity": "Neurons, synapses and spikes",
    "jaxsnn.window": "Neurons, synapses and spikes",
    "jaxsnn.encoding": "Neurons, synapses and spikes",
    "jaxsnn.config": "Networks that steer",
    "jaxsnn.network": "Networks that steer",
    "jaxsnn.presets": "Networks that steer",
    "jaxsnn.rewards": "Networks that steer",
    "jaxsnn.agents": "Networks that steer",
    "jaxsnn.world": "The robot's world",
    "jaxsnn.scenarios": "The robot's world",
    "jaxsnn.drivers": "The robot's world",
    "jaxsnn.status": "Trials and experiments",
    "jaxsnn.maps": "The robot's world",
    "jaxsnn.random_maps": "The robot's world",
    "jaxsnn.trials": "Trials and experiments",
    "jaxsnn.experiment": "Trials and experiments",
    "fusion.data": "Data",
    "fusion.failures": "Sensor failures",
    "fusion.models": "Models",
    "fusion.encoders": "Models",
    "fusion.config": "Models",
    "fusion.presets": "Models",
    "fusion.losses": "Training and evaluation",
    "fusion.train": "Training and evaluation",
    "fusion.loop": "Training and evaluation",
    "fusion.evaluate": "Training and evaluation",
    "fusion.fitted": "A network in use",
    "fusion.lattice": "Layers",
    "fusion.lattice.estimators": "Whole models",
    "fusion.lattice.premade": "Whole models",
    "fusion.lattice.optimizer": "Constraints in training",
    "fusion.lattice.tagged": "Constraints in training",
    "fusion.detection.kitti": "Files of KITTI and average precision",
    "fusion.detection.learning": "The detector",
    "fusion.detection.config": "The detector",
    "fusion.detection.presets": "The detector",
    "fusion.detection.sensors": "Sensor failures",
    "failure.circuits": "Circuits and simulators",
    "failure.simulators": "Circuits and simulators",
    "failure.search": "Search",
    "failure.models": "Models of a search",
    "failure.rare_events": "How likely is a failure",
    "failure.form": "How likely is a failure",
    "failure.status": "Circuits and simulators",
    "failure.estimates": "How likely is a failure",
    "failure.subset": "How likely is a failure",
}
"""Where a name is defined (the longest prefix counts) -> the task that it is listed under."""

HEAD = """\
# Public names

Read off the `__all__` of the packages by `python scripts/tools/render_api.py`; a name leads to its
docstring. Tests check that the list is up to date and that each function on it is typed, says what
it computes, can be traced and batched.

**What is stable.** A name on this page keeps its meaning and its arguments within a minor version
(0.1.x); what changes between minor versions stands in `CHANGELOG.md`. Everything else may change at
any time: names in modules that are not listed, names with a leading underscore, `scripts`, `tests`.
A listed module (`jaxsnn.world`, the layers of `fusion.lattice`, `failure.circuits`) stands for its
functions and classes without a leading underscore. What left this list is still there, in its own
module.
`fusion.detection` is younger than the rest: its names may still move; the changelog will say so.

**What holds for all of them.** No function keeps state between calls or changes a setting of jax.
Functions of arrays are pure: they can be jitted, vmapped, differentiated where that is defined, and
used inside `lax.scan`. Arguments come as `config, params, state, inputs`, then `key` by name;
`init(key, config)` starts with the key. A `Config` is a frozen dataclass and static under `jit`,
`Params` are floats that may be traced and vmapped, a `State` is what a step changes. The circuit
solver and the Gaussian process work in float64 and expect `with jax.enable_x64(True):` around calls
from your own code; their host functions (`simulate`, `ask`, `run`) set it themselves.
`import jaxsnn, fusion, failure` prints nothing and leaves brax, matplotlib, orbax and xarray alone
until they are needed.
"""

TAIL = """
## Modules by their full path

The pages of the documentation use these as well, as `from jaxsnn.ppo import PPOConfig`: they bring
large libraries along, or serve one task. They are documented and tested, but their names may move;
the changelog will say so.

| module | what it is for |
|---|---|
"""
