"""Block diagrams of the networks, with their sizes read from the configurations.

python scripts/tools/draw_systems.py            # write docs/images/NAME.svg
python scripts/tools/draw_systems.py --check    # only say whether they are up to date
"""

from __future__ import annotations

import dataclasses

from snn_fusion_failure.documentation import schematics
from snn_fusion_failure.documentation.architecture import keep
from snn_fusion_failure.documentation.svg import SOFT, Canvas
from snn_fusion_failure.runs import repository

FOLDER = repository.ROOT / "docs" / "images"


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw the systems."""

    check: bool = False
    """Do not write; exit with 2 when a drawing is out of date."""


def snn() -> str:
    """The networks S1 to S4."""
    from jaxsnn.config import NETWORKS, network_config

    canvas = Canvas(1000, 500, "Networks S1 to S4: seven input groups, a hidden layer, two motors")
    canvas.text(20, 30, "Spiking networks S1 to S4", size=18, anchor="start", bold=True)
    words = "robot\n\nfive sonars,\ndistance and\nangle of\nthe target"
    canvas.box(20, 60, 120, 310, words, colour="green")
    names = [f"sonar {i}" for i in range(1, 6)] + ["distance", "angle"]
    for i, name in enumerate(names):
        y = 60 + i * 40
        canvas.line((140, y + 15), (190, y + 15), arrow=True)
        canvas.box(190, y, 120, 30, name, colour="grey", size=12)
        for target in (135, 265):
            canvas.line((310, y + 15), (420, target), colour="#c3ccd5", width=1)
    config = network_config("S4")
    for y, side in ((90, "left"), (220, "right")):
        words = f"{config.n_half} hidden neurons\n{side} half"
        canvas.box(420, y, 170, 90, words, colour="blue")
        canvas.line((590, y + 45), (660, y + 45), arrow=True)
        canvas.circle(690, y + 45, 30, colour="yellow")
        canvas.text(690, y + 50, side, size=12)
        canvas.line((720, y + 45), (770, 200), arrow=True)
    canvas.box(770, 170, 115, 60, "turn =\nrate difference", size=12)
    canvas.line((828, 230), (828, 352), (140, 352), arrow=True, dashed=True)
    canvas.text(660, 346, "move", size=11, colour=SOFT)
    inputs = f"{config.group_exc} excitatory, {config.group_inh} inhibitory Poisson neurons each"
    canvas.text(250, 392, inputs, size=11, colour=SOFT)
    canvas.text(690, 392, "every synapse learns; a reward for each motor", size=11, colour=SOFT)
    for i, name in enumerate(NETWORKS):
        one = network_config(name)
        hidden = f"{one.hidden_exc} excitatory"
        hidden += f", {one.hidden_inh} inhibitory hidden" if one.hidden_inh else " hidden"
        words = f"{one.rule} rule, {one.encoding} rates, {hidden}"
        left, y = 20 + 480 * (i % 2), 436 + 26 * (i // 2)
        canvas.text(left, y, name, size=13, anchor="start", bold=True)
        canvas.text(left + 30, y, words, size=12, anchor="start")
    return canvas.render()


def argate() -> str:
    """ARGate: main path, gate, auxiliary paths and targets."""
    from fusion.config import ModelConfig

    config = ModelConfig()
    canvas = Canvas(980, 420, "ARGate: encoders, gate, fusion; auxiliary losses steer the gate")
    canvas.text(20, 30, "ARGate", size=18, anchor="start", bold=True)
    canvas.box(20, 264, 940, 142, colour="red", radius=8)
    for i, name in enumerate(("sensor 1", "sensor 2", f"sensor {config.n_sensors}")):
        y = 70 + i * 66
        canvas.text(62, y + 24, name, size=12)
        canvas.line((100, y + 20), (130, y + 20), arrow=True)
        canvas.box(130, y, 110, 40, "encoder", colour="grey")
        canvas.line((240, y + 20), (520, y + 20), arrow=True)
        canvas.circle(534, y + 20, 13, colour="yellow")
        canvas.text(534, y + 25, "x", size=14)
        canvas.line((548, y + 20), (610, 156), arrow=True)
        canvas.dot(270, y + 20)
    canvas.text(185, 190, "...", size=14)
    canvas.line((270, 222), (270, 41), (300, 41), arrow=True)
    canvas.line((270, 222), (270, 323), (290, 323), arrow=True)
    gate = f"gate, {config.gate_width} hidden units"
    canvas.box(300, 26, 170, 30, gate, colour="yellow", size=12)
    canvas.line((470, 41), (534, 41), (534, 76), arrow=True)
    canvas.text(548, 56, f"weights, {config.normalizer}", size=11, anchor="start", colour=SOFT)
    canvas.box(610, 130, 100, 52, f"fusion\n({config.fusion})", colour="blue")
    canvas.line((710, 156), (750, 156), arrow=True)
    head = ", ".join(map(str, config.head_widths))
    canvas.box(750, 130, 90, 52, f"head\n{head}", colour="blue")
    canvas.line((840, 156), (880, 156), arrow=True)
    canvas.text(925, 160, "classes", size=12)
    canvas.text(34, 286, "in training only", size=12, anchor="start", bold=True)
    canvas.box(290, 300, 150, 46, "auxiliary heads,\none per sensor", size=12)
    canvas.line((440, 323), (500, 323), arrow=True)
    canvas.box(500, 300, 120, 46, "auxiliary\nlosses", size=12)
    canvas.line((620, 323), (670, 323), arrow=True)
    canvas.box(670, 300, 130, 46, "monotone lattice:\ntargets", colour="green", size=12)
    canvas.line((800, 323), (834, 323), arrow=True)
    canvas.box(834, 300, 112, 46, "pull on the\nfusion weights", colour="yellow", size=12)
    words = "ARGate-WS: shared encoders; ARGate+: targets by a softmax of the losses; "
    canvas.text(34, 386, words + "ARGate-L: targets learned by the lattice", size=12,
                anchor="start", colour=SOFT)  # fmt: skip
    return canvas.render()


def rev_argate() -> str:
    """Rev-ARGate in a search: forward to features, backward to parameters."""
    from failure.rev_argate import RevArgateConfig

    config = RevArgateConfig()
    canvas = Canvas(980, 330, "Rev-ARGate: learn features of parameters, search in the active ones")
    canvas.text(20, 30, "Rev-ARGate", size=18, anchor="start", bold=True)
    canvas.text(20, 66, "learn, from the simulations so far", size=12, anchor="start", colour=SOFT)
    steps = (
        ("parameters x\nof the circuit", "grey", 130),
        (f"reversible network,\n{config.depth} blocks", "blue", 150),
        ("features z,\nas many as x", "grey", 120),
        (f"ARGate on the features,\ngate of {config.gate_width}", "yellow", 170),
        ("specification;\nweights of the features", "grey", 170),
    )
    x = 20.0
    for i, (words, colour, width) in enumerate(steps):
        canvas.box(x, 80, width, 56, words, colour=colour, size=12)
        if i < len(steps) - 1:
            canvas.line((x + width, 108), (x + width + 45, 108), arrow=True)
        x += width + 45
    canvas.line((865, 136), (865, 230), (840, 230), arrow=True)
    canvas.text(872, 190, "the few with\nmost weight", size=11, anchor="start", colour=SOFT)
    canvas.text(20, 190, "search", size=12, anchor="start", colour=SOFT)
    restore = f"restore the others\n(zeros, or {config.restoration.hidden} hidden Bayesian)"
    back = (
        ("Gaussian process\nover active features", "green", 670, 170),
        (restore, "blue", 400, 215),
        ("reversible network,\nbackwards", "blue", 205, 150),
        ("simulate x", "red", 20, 140),
    )
    for i, (words, colour, left, width) in enumerate(back):
        canvas.box(left, 202, width, 56, words, colour=colour, size=12)
        if i < len(back) - 1:
            canvas.line((left, 230), (back[i + 1][2] + back[i + 1][3], 230), arrow=True)
    canvas.line((85, 202), (85, 136), arrow=True)
    canvas.text(94, 176, "one more row", size=11, anchor="start", colour=SOFT)
    return canvas.render()


DRAWINGS = {
    "ldo": schematics.ldo,
    "buck": schematics.buck,
    "snn": snn,
    "argate": argate,
    "rev_argate": rev_argate,
}
"""Name of the file -> what draws it."""


def main(config: Config) -> dict[str, int]:
    """Write or check the drawings."""
    for name, draw in DRAWINGS.items():
        keep(FOLDER / f"{name}.svg", draw(), check=config.check,
             command="scripts/tools/draw_systems.py")  # fmt: skip
    return {"drawings": len(DRAWINGS)}
