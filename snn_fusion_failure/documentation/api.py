"""The public names: what the `__all__` of the packages lists, grouped by task.

    python scripts/tools/render_api.py            # write docs/api.md and docs/reference/
    python scripts/tools/render_api.py --check    # only say whether they are up to date

The packages are read, not imported, so this takes a second. The test suite fails when a page is
out of date. mkdocstrings fills the pages of docs/reference/ from the docstrings.
"""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator

from snn_fusion_failure.documentation import docstrings
from snn_fusion_failure.documentation.reading import (
    Definition,
    find_file,
    one_line,
    read_module,
    signature,
    summary_of,
)
from snn_fusion_failure.runs import repository, write_text

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
    "jaxsnn.drivers": "drivers that do not learn, for comparison",
    "jaxsnn.navigation": "the robot as a task for PPO",
    "jaxsnn.ppo": "proximal policy optimisation",
    "jaxsnn.plots": "pictures (matplotlib)",
    "fusion.data.fixed": "the failing sensors that the source prints",
    "fusion.estimator": "ARGate with the face of scikit-learn",
    "fusion.modules": "ARGate and its loss around flax modules of one's own",
    "fusion.targets": "what ARGate-L learns its targets with",
    "fusion.plots": "pictures (matplotlib)",
    "fusion.lattice.plots": "pictures (matplotlib)",
    "fusion.detection.kitti": "files of KITTI and the official score",
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


@dataclasses.dataclass(frozen=True)
class Config:
    """Write the pages of public names."""

    check: bool = False
    """Do not write; exit with 2 when a page is out of date."""


@dataclasses.dataclass(frozen=True)
class Name:
    """A public name.

    Attributes:
        package: whose `__all__` lists it.
        name: as listed.
        home: the module that defines it, or the module itself.
        node: definition of a function or a class; None for a module or a constant.
        kind: function, class, module or constant.
        text: first paragraph of its docstring.
        inner: its name where it is defined.
    """

    package: str
    name: str
    home: str
    node: Definition | None
    kind: str
    text: str
    inner: str = ""

    @property
    def path(self) -> str:
        """The dotted name by which it is imported."""
        return f"{self.package}.{self.name}"

    @property
    def task(self) -> str:
        """The heading that it stands under."""
        found = [p for p in TASKS if f"{self.home}.".startswith(f"{p}.")]
        return TASKS[max(found, key=len)] if found else PACKAGES[self.package]


def resolve(package: str, name: str) -> Name:
    """Follow imports from a package to where a name is defined.

    Raises:
        ValueError: it is not there.
    """
    module, wanted = package, name
    while True:
        if (path := find_file(f"{module}.{wanted}")) is not None:
            return Name(
                package, name, f"{module}.{wanted}", None, "module", read_module(path).summary
            )
        path = find_file(module)
        held = read_module(path) if path else None
        if held is not None and wanted in held.definitions:
            node = held.definitions[wanted]
            kind = "class" if isinstance(node, ast.ClassDef) else "function"
            return Name(package, name, module, node, kind, summary_of(node), wanted)
        if held is not None and wanted in held.constants:
            text = one_line(held.constants[wanted])
            return Name(package, name, module, None, "constant", text, wanted)
        if held is None or wanted not in held.imported:
            raise ValueError(f"{package}.{name} is listed in `__all__`, but not in {module}")
        module, inner = held.imported[wanted]
        wanted = inner or wanted


def listed(package: str) -> list[Name]:
    """The public names of a package, in alphabetical order.

    Raises:
        ValueError: the package lists what it does not have.
    """
    path = find_file(package)
    if path is None or not read_module(path).names:
        return []
    return [resolve(package, name) for name in sorted(read_module(path).names)]


def functions(package: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """(where it is defined, definition) of the public functions, those of listed modules too."""
    for name in listed(package):
        if isinstance(name.node, ast.FunctionDef):
            yield f"{name.home}.{name.node.name}", name.node
        elif name.kind == "module" and (path := find_file(name.home)) is not None:
            module = read_module(path)
            for inner in module.names:
                node = module.definitions.get(inner)
                if isinstance(node, ast.FunctionDef):
                    yield f"{module.name}.{inner}", node


def _cell(text: str) -> str:
    """Text that survives in a table cell."""
    return docstrings.to_markdown(text).replace("|", "\\|")


def page_of(package: str) -> str:
    """File name of a package's reference page."""
    return f"reference/{package.split('.')[-1]}.md"


def _by_task(names: list[Name]) -> dict[str, list[Name]]:
    order = list(dict.fromkeys(TASKS.values()))
    held: dict[str, list[Name]] = {}
    for name in sorted(names, key=lambda n: order.index(n.task) if n.task in order else len(order)):
        held.setdefault(name.task, []).append(name)
    return held


def _package_pages(package: str) -> tuple[list[str], list[str]]:
    """Lines of the list and of the reference page."""
    title = f"{PACKAGES[package]}: `{package}`"
    lines = ["", f"## {title}"]
    reference = [f"# {title}", "", "Back to the [list of public names](../api.md)."]
    for task, group in _by_task(listed(package)).items():
        lines += ["", f"### {task}", "", "| name | what it is |", "|---|---|"]
        reference += ["", f"## {task}"]
        for name in group:
            shown = signature(name.node) if name.node else name.name
            shown = shown.replace(f"{name.inner}(", f"{name.name}(", 1) if name.inner else shown
            link = f"[`{shown}`]({page_of(package)}#{name.path})"
            lines.append(f"| {link} | {_cell(name.text)} |")
            target = name.home if name.kind == "module" else f"{name.home}.{name.inner}"
            reference += ["", f'<a id="{name.path}"></a>', "", f"::: {target}"]
    return lines, reference


def render() -> dict[str, str]:
    """Path below docs/ -> text of each page."""
    lines = [HEAD.rstrip()]
    pages = {}
    for package in filter(listed, PACKAGES):
        more, reference = _package_pages(package)
        lines += more
        pages[page_of(package)] = "\n".join(reference) + "\n"
    lines += [TAIL.rstrip(), *(f"| `{module}` | {text} |" for module, text in BY_PATH.items())]
    return {"api.md": "\n".join(lines) + "\n", **pages}


def main(config: Config) -> dict[str, int]:
    """Write or check the pages; returns how many names they list."""
    docs = repository.ROOT / "docs"
    pages = render()
    for name, text in pages.items():
        path = docs / name
        if config.check and (not path.exists() or path.read_text(encoding="utf-8") != text):
            raise ValueError(f"{path} is out of date: run `python scripts/tools/render_api.py`")
        if not config.check:
            write_text(path, text)
    return {"names": sum(len(listed(p)) for p in PACKAGES), "pages": len(pages)}
