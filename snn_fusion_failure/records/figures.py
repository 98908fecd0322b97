"""The source's figures that are results, and where ours lie; put into the page as data."""

from __future__ import annotations

import base64
import dataclasses
from pathlib import Path

from snn_fusion_failure.records.html import escape, tag
from snn_fusion_failure.runs import repository


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure of the source.

    Attributes:
        number: in the source.
        caption: what ours shows.
        command: that draws it.
        record: file of record, from the repository root; the first that exists is shown.
        fresh: file of a quick run, from its folder; used where there is none of record.
        large: takes the width of two.
    """

    number: str
    caption: str
    command: str
    record: tuple[str, ...]
    fresh: str | None = None
    large: bool = False


_SNN = "python scripts/studies/figures_snn.py"


def _trials() -> list[Figure]:
    figures = []
    for scenario in (1, 2, 3):
        for offset, phase in enumerate(("learning", "testing")):
            figures.append(
                Figure(
                    f"2.{7 + 2 * scenario + offset}",
                    f"Trials of one S4 robot in the {phase} phase of Scenario {scenario}",
                    _SNN,
                    (f"docs/images/snn_scenario{scenario}_{phase}.png",),
                    f"2.3/S4/trajectories_{phase}.png" if scenario == 1 else None,
                )
            )
    return figures


def _trend(number: str, table: str, circuit: str, spec: str, title: str) -> Figure:
    folder = f"table_{table.replace('.', '_')}"
    return Figure(
        number,
        f"Worst {spec.replace('_', ' ')} so far of the {title} against simulations: median of the "
        "searches and the band of their middle half",
        f"python scripts/studies/reproduce.py --table {table}",
        (
            f"runs/{folder}/{circuit}/{spec}/box/trend.png",
            f"docs/images/{folder}_{spec}.png",
        ),
        f"{table}/{circuit}/{spec}/box/trend.png",
    )


FIGURES = (
    Figure("2.2", "STDP: change of a weight by one pair of spikes, against their lag", _SNN,
           ("docs/images/snn_stdp.png",)),
    Figure("2.3", "The same under rewards: additive RM-STDP", _SNN,
           ("docs/images/snn_rm_stdp.png",)),
    *_trials(),
    Figure("3.7", "Fusion weights of channel total_acc_y when it has failed and when it is clean",
           "python scripts/studies/render_results.py", ("docs/images/study_channel_weights.png",),
           large=True),
    _trend("4.7", "4.1", "ldo", "undershoot", "LDO regulator"),
    _trend("4.8", "4.2", "dcdc", "output_accuracy", "DC-DC converter"),
)  # fmt: skip


def find(figure: Figure, fresh: Path, root: Path = repository.ROOT) -> tuple[Path, str] | None:
    """File and origin of a figure; None when it was not drawn."""
    for name in figure.record:
        if (root / name).is_file():
            return root / name, "record"
    if figure.fresh and (fresh / figure.fresh).is_file():
        return fresh / figure.fresh, "quick run"
    return None


def figure_html(figure: Figure, fresh: Path, root: Path = repository.ROOT) -> str:
    """One figure with its caption, or the words that it was not run."""
    found = find(figure, fresh, root)
    title = f"Figure {figure.number}. {figure.caption}"
    if found is None:
        picture, origin = tag("div", "○ not run", klass="missing"), "to draw it"
    else:
        path, origin = found
        data = base64.b64encode(path.read_bytes()).decode("ascii")
        source = f"data:image/png;base64,{data}"
        picture = f'<img src="{source}" alt="{escape(title)}" loading="lazy">'
        origin = {"record": "of record", "quick run": "of the quick run"}[origin]
    caption = tag(
        "figcaption",
        tag("b", f"Figure {escape(figure.number)}"),
        f". {escape(figure.caption)}. ",
        tag("small", f"({escape(origin)}: {tag('code', escape(figure.command))})"),
    )
    size = {"klass": "large"} if figure.large else {}
    return tag("figure", picture, caption, id=f"figure-{figure.number}", **size)


def gallery(fresh: Path, root: Path = repository.ROOT) -> str:
    """All figures."""
    return tag("div", *(figure_html(f, fresh, root) for f in FIGURES), klass="figures")
