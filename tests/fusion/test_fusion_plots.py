"""Pictures: what is drawn is what was given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from fusion.plots import plot_cases, plot_channel_weights, plot_confusion, plot_gate, plot_training

NAMES = ("ear", "eye", "nose")
RNG = np.random.default_rng(0)
MASK = np.tile(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]], bool), (20, 1))
WEIGHTS = RNG.dirichlet(np.ones(3), 60)


def saved(figure: Figure, path: Path) -> Figure:
    figure.savefig(path / "figure.png", dpi=50)
    assert (path / "figure.png").stat().st_size > 2000
    return figure


def test_confusion_shows_counts_and_accuracy(tmp_path: Path) -> None:
    figure = saved(plot_confusion([[8, 2, 0], [1, 9, 0], [0, 0, 10]], NAMES), tmp_path)
    axes = figure.axes[0]
    cells = {t.get_position(): t.get_text() for t in axes.texts}
    assert cells == {(0, 0): "8", (1, 0): "2", (0, 1): "1", (1, 1): "9", (2, 2): "10"}
    assert "90.0 %" in axes.get_title()
    np.testing.assert_allclose(axes.images[0].get_array()[0], [0.8, 0.2, 0.0])
    with pytest.raises(ValueError, match=r"matrix.shape=\(2, 2\): expected \(3, 3\)"):
        plot_confusion(np.eye(2), NAMES)


def test_cases_show_accuracy_source_and_ceiling(tmp_path: Path) -> None:
    cases = {"all work": (97.5, 96.7, None), "some fail": (90.0, None, 95.0)}
    axes = saved(plot_cases(cases), tmp_path).axes[0]
    assert [bar.get_width() for bar in axes.patches] == [97.5, 90.0]
    marks = {line.get_label(): line.get_xdata()[0] for line in axes.lines}
    assert marks == {"source": 96.7, "best possible": 95.0}
    assert [label.get_text() for label in axes.get_yticklabels()] == list(cases)
    with pytest.raises(ValueError, match="expected at least one case"):
        plot_cases({})


def test_gate_shows_medians_of_corrupted_examples(tmp_path: Path) -> None:
    axes = saved(plot_gate(WEIGHTS, MASK, NAMES), tmp_path).axes[0]
    drawn = [tuple(map(float, line.get_ydata())) for line in axes.lines]
    rows = MASK.any(axis=1)
    for k in range(3):
        for failed in (False, True):
            median = float(np.median(WEIGHTS[rows & (MASK[:, k] == failed), k]))
            assert (pytest.approx(median), pytest.approx(median)) in drawn
    assert [t.get_text() for t in axes.get_xticklabels()] == list(NAMES)
    with pytest.raises(ValueError, match="expected examples with a failed channel"):
        plot_gate(WEIGHTS, np.zeros_like(MASK), NAMES)
    with pytest.raises(ValueError, match=r"expected \[N, 3\] for both"):
        plot_gate(WEIGHTS[:, :2], MASK, NAMES)


def test_channel_weights_has_a_column_per_model(tmp_path: Path) -> None:
    models = {"one": (WEIGHTS, MASK), "two": (WEIGHTS[::-1], MASK)}
    figure = saved(plot_channel_weights(models, "eye", NAMES, bins=10), tmp_path)
    panels = figure.axes
    assert [p.get_title() for p in panels[:2]] == ["one", "two"] and len(panels) == 4
    for panel, chosen in ((panels[0], MASK[:, 1]), (panels[2], MASK.any(axis=1) & ~MASK[:, 1])):
        heights = [bar.get_height() for bar in panel.patches]
        assert sum(heights) == pytest.approx(100.0)
        assert f"n = {chosen.sum()}" in panel.texts[0].get_text()
        assert f"mean {WEIGHTS[chosen, 1].mean():.3f}" in panel.texts[0].get_text()
    with pytest.raises(ValueError, match=r"channel='mouth': expected one of 'ear'"):
        plot_channel_weights(models, "mouth", NAMES)
    with pytest.raises(ValueError, match="expected at least one; give its weights"):
        plot_channel_weights({}, "eye", NAMES)


def test_training_curves(tmp_path: Path) -> None:
    loss = np.array([[3.0, 2.0, 1.0], [5.0, 4.0, 3.0]])
    curves = {"a": {"loss": loss, "accuracy": [0.1, 0.5, 0.9]}, "b": {"loss": loss[0]}}
    figure = saved(plot_training(curves), tmp_path)
    left, right = figure.axes
    assert [line.get_label() for line in left.lines] == ["a", "b"] and len(right.lines) == 1
    np.testing.assert_allclose(left.lines[0].get_ydata(), [4.0, 3.0, 2.0])
    np.testing.assert_allclose(left.lines[0].get_xdata(), [1, 2, 3])
    assert len(left.collections) == 1
    with pytest.raises(ValueError, match="expected at least one model"):
        plot_training({})
