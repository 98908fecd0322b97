"""The house stands: arrows point down, no circle of files, libraries where they belong."""

from __future__ import annotations

import ast
import collections
import importlib
import subprocess
from pathlib import Path

import pytest

from snn_fusion_failure.documentation import api, imports

ROOT = Path(__file__).resolve().parent.parent
GRAPH = imports.read()
PACKAGES = imports.ROOMS[:4]
BELOW = {
    "jaxsnn": (),
    "fusion": (),
    "failure": (),
    "snn_fusion_failure": PACKAGES[:3],
    "scripts": PACKAGES,
}
"""Room -> the rooms that it may import from."""
RE_EXPORT = {
    "jaxsnn.network",
    "fusion.detection.kitti.files",
    "failure.rare_events",
    "failure.search.bayesopt",
}
"""Modules that gather names of their neighbours under one roof."""
ARROWS = {("failure.rev_argate", "fusion"), ("failure.revnet", "fusion")}
"""What of one system uses another: an ARGate over features, and the coupling of reversible nets."""
CEILING = 320
LONGER = {
    "fusion.detection.kitti.average_precision",
    "fusion.lattice.linear",
    "jaxsnn.plots",
    "jaxsnn.world",
    "scripts.benchmarks.bench_fusion",
}
"""Files above the ceiling; the list only shrinks."""
SAME_MEANING = {
    "_checks": "refusals of what a user gives",
    "config": "the frozen settings of a part",
    "blocks": "what a whole is put together from: coupled convolutions there, circuits here",
    "encoder": "the encoder of all sensors as a flax module",
    "plots": "pictures of a part",
    "presets": "settings of a part by name",
    "circuit": "a circuit as a search takes it",
    "reference": "a circuit in ngspice",
    "schematic": "a circuit as drawn",
    "status": "how a run ended, and what to do about it",
    "neurons": "leaky integrate-and-fire neurons: in volts and seconds there, learning here",
    "network": "neurons or filters and their connections",
    "geometry": "shapes, distances and overlaps",
    "__main__": "what `python -m` runs",
    "models": "what is trained: networks there, surrogates here",
    "runs": "a run that is kept on the disk and goes on",
    "folder": "the files of a run or a sweep",
    "files": "reads or writes whole files",
}
"""Module names that may occur more than once, and the one thing they mean."""


@pytest.mark.parametrize("room", imports.ROOMS)
def test_arrows_point_down(room: str) -> None:
    up = [
        f"{module} -> {target}"
        for module, target in GRAPH.above(room)
        if target.split(".")[0] not in BELOW[room] and (module, target.split(".")[0]) not in ARROWS
    ]
    assert up == []


def test_no_file_imports_a_script() -> None:
    found = [
        f"{module} -> {target}"
        for module, targets in GRAPH.edges.items()
        for target in targets
        # The torch peer of a benchmark is a file of its own, since torch is no dependency.
        if target.startswith("scripts") and target != "scripts.benchmarks.torch_peer"
    ]
    assert found == []


def test_tests_import_scripts_as_files_only() -> None:
    graph = imports.read(rooms=("tests", "scripts"))
    found = [m for m, _ in graph.above("tests")]
    assert found == [], "use tests._scripts.load_script"


def test_no_circle_of_files() -> None:
    assert GRAPH.circles() == []


def test_a_circle_is_found(tmp_path: Path) -> None:
    for name, text in (
        ("a", "import room.b"),
        ("b", "def f():\n    from room import a"),
        ("c", ""),
    ):
        (tmp_path / "room").mkdir(exist_ok=True)
        (tmp_path / "room" / f"{name}.py").write_text(text, encoding="utf-8")
    (tmp_path / "room" / "__init__.py").write_text("from room import a, b, c", encoding="utf-8")
    graph = imports.read(tmp_path, ("room",))
    assert graph.circles() == [("room.a", "room.b")]


@pytest.mark.parametrize(
    ("library", "place"),
    [
        ("brax", ("jaxsnn.brax_env",)),
        ("matplotlib", ("plots",)),
        ("pooch", ("fusion.data",)),
        ("zipfile", ("fusion.data",)),
        ("gzip", ("fusion.data",)),
        ("torch", ()),
        ("ray", ("snn_fusion_failure.sweeps",)),
        ("submitit", ("snn_fusion_failure.sweeps",)),
        ("xarray", ("snn_fusion_failure.sweeps",)),
        ("rich", ("snn_fusion_failure.runs",)),
        ("tyro", ("snn_fusion_failure",)),
    ],
)
def test_a_library_stays_in_its_place(library: str, place: tuple[str, ...]) -> None:
    def allowed(module: str) -> bool:
        if library == "matplotlib":
            return module.split(".")[-1].endswith("plots")
        return module.startswith(place) if place else False

    users = [m for m, libraries in GRAPH.outside.items() if library in libraries]
    strangers = [m for m in users if not m.startswith("scripts.") and not allowed(m)]
    assert strangers == []


def test_lattices_are_usable_alone() -> None:
    for module, targets in GRAPH.edges.items():
        if module.startswith("fusion.lattice"):
            strangers = {t for t in targets if not t.startswith("fusion.lattice")}
            assert strangers == set(), module


def test_file_formats_are_read_in_their_rooms_only() -> None:
    """Rows and columns of a data set are read in `fusion/data` and `fusion/detection/kitti`."""
    rooms = ("fusion.data", "fusion.detection.kitti")
    readers = ("loadtxt", "genfromtxt", "fromfile", "read_csv", "loadmat")
    for module, path in GRAPH.files.items():
        if module.startswith(("fusion", "jaxsnn", "failure")) and not module.startswith(rooms):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            used = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
            assert used.isdisjoint(readers), f"{module} reads {used & set(readers)}"


def test_commands_parse_call_and_save_within_200_lines() -> None:
    long = {
        module.split(".")[-1]
        for module, path in GRAPH.files.items()
        if (module.startswith("snn_fusion_failure.commands.") or module.count(".") == 1)
        and module.startswith(("snn_fusion_failure.commands.", "scripts."))
        and len(path.read_text(encoding="utf-8").splitlines()) > 200
    }
    assert long == set()


def test_a_launcher_holds_no_code_of_its_own() -> None:
    for module, path in GRAPH.files.items():
        if module.startswith("scripts.") and module.count(".") == 1:
            assert len(path.read_text(encoding="utf-8").splitlines()) <= 20, module


def test_a_file_is_one_idea_of_at_most_320_lines() -> None:
    long = {
        module
        for module, path in GRAPH.files.items()
        if len(path.read_text(encoding="utf-8").splitlines()) > CEILING
    }
    assert long - LONGER == set(), "split it along its ideas"
    assert LONGER - long == set(), "take it off the list: it is short now, or gone"


def test_no_module_name_has_two_meanings() -> None:
    held = collections.defaultdict(list)
    for module in GRAPH.files:
        # A command or a study is called like the package that it works with.
        named = not module.startswith(("scripts", "snn_fusion_failure.sweeps.studies."))
        if named and module.count("."):
            held[module.split(".")[-1]].append(module)
    twice = {name: modules for name, modules in held.items() if len(modules) > 1}
    assert set(twice) - set(SAME_MEANING) == set(), twice


def test_no_package_hides_one_of_its_modules() -> None:
    """`from fusion.fit import fit` in `fusion` would make `fusion.fit` the function."""
    hidden = []
    for module, path in GRAPH.files.items():
        if path.name != "__init__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    bound = f"{module}.{alias.asname or alias.name}"
                    if bound in GRAPH.files and bound != f"{node.module}.{alias.name}":
                        hidden.append(bound)
    assert hidden == []


def lists_names(path: Path) -> bool:
    """Does a file assign `__all__`."""
    return any(
        isinstance(target, ast.Name) and target.id == "__all__"
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign)
        for target in node.targets
    )


def test_only_packages_list_their_names() -> None:
    """A module's names are those without a leading underscore; a second list would only age."""
    found = {m for m, p in GRAPH.files.items() if p.name != "__init__.py" and lists_names(p)}
    assert found - RE_EXPORT == set(), (
        "remove `__all__`; use a leading underscore for what is private"
    )
    assert RE_EXPORT - found == set()


@pytest.mark.parametrize("package", api.PACKAGES)
def test_every_listed_name_is_there(package: str) -> None:
    module = importlib.import_module(package)
    names = module.__all__
    assert [name for name in names if not hasattr(module, name)] == []
    assert len(set(names)) == len(names)


def test_git_knows_every_file_of_the_packages() -> None:
    """A pattern of .gitignore that takes in a package would leave it out of the wheel, too."""
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    files = [str(p.relative_to(ROOT)) for m, p in GRAPH.files.items() if m.startswith(PACKAGES)]
    done = subprocess.run(
        ["git", "check-ignore", "--no-index", *files], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout == ""
