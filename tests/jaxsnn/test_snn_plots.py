"""Pictures hold what they were given; bad input is refused; the GIF has one frame for each step."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.animation import PillowWriter
from matplotlib.patches import Circle, Polygon
from PIL import Image

from jaxsnn import maps, plots, scenarios


def test_map_shows_every_obstacle_and_not_the_padding() -> None:
    figure = plots.plot_maps({"a": scenarios.scenario(3)})
    ax = figure.axes[0]
    polygons = [p for p in ax.patches if isinstance(p, Polygon)]
    circles = [p for p in ax.patches if isinstance(p, Circle)]
    assert len(polygons) == 7
    assert len(circles) == 3 + 1  # obstacles and the one start circle that is used
    corners = polygons[0].get_xy()[:-1]
    np.testing.assert_allclose(corners, np.asarray(scenarios.scenario(3).segments)[:4, :2])


def test_trajectories_show_paths_and_their_ends() -> None:
    paths = [np.array([[90.0, 300.0], [200.0, 300.0]]), np.array([[710.0, 300.0], [500.0, 200.0]])]
    figure = plots.plot_trajectories(
        scenarios.scenario(1), paths, arrived=[True, False], collided=[False, True], shortest=True
    )
    ax = figure.axes[0]
    drawn = [np.asarray(line.get_xydata()) for line in ax.lines]
    assert any(d.shape == (2, 2) and np.array_equal(d, paths[1]) for d in drawn)
    legend = ax.get_legend()
    assert legend is not None
    assert {t.get_text() for t in legend.get_texts()} == {"arrived", "collision", "shortest path"}
    with pytest.raises(ValueError, match="paths=<2>, arrived=<1>"):
        plots.plot_trajectories(
            scenarios.scenario(1), paths, arrived=[True], collided=[False, True]
        )


def test_learning_curve_is_the_mean_in_percent() -> None:
    values = np.array([[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]])
    line = plots.plot_learning_curves({"S4": values}, window=2).axes[0].lines[0]
    np.testing.assert_allclose(line.get_ydata(), [25.0, 75.0, 100.0])
    np.testing.assert_allclose(line.get_xdata(), [2, 3, 4])


def test_plasticity_curves_and_raster() -> None:
    lag = np.linspace(-50, 50, 101)
    change = np.where(lag > 0, np.exp(-np.abs(lag) / 20), -np.exp(-np.abs(lag) / 20))
    assert len(plots.plot_stdp_curve(lag, change).axes[0].lines) == 4  # two halves, two zero lines
    figure = plots.plot_rm_stdp_curves(lag, {"r = 1": change, "r = -1": -change})
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert len(legend.get_texts()) == 2
    rng = np.random.default_rng(0)
    spikes = {"input": rng.random((50, 12)) < 0.1, "motor": rng.random((50, 2)) < 0.2}
    figure = plots.plot_spike_raster(spikes, {"input to motor": rng.normal(size=(12, 2))})
    segments = figure.axes[0].collections[0].get_segments()
    assert len(segments) == spikes["input"].sum()


def test_gif_has_a_frame_for_each_step_and_moves_the_obstacles(tmp_path: Path) -> None:
    params = maps.make_map(
        [[(300.0, 200.0), (340.0, 200.0), (320.0, 240.0)]],
        polygon_velocity=[(20, 0)],
        patrol_steps=5,
        target=(700, 300),
        starts=[(100, 300, 20)],
    )
    path = np.stack([100 + 15.0 * np.arange(4), np.full(4, 300.0)], axis=1)
    movie = plots.plot_trial(params, path, np.zeros(4), sonar=np.full((4, 5), 80.0), fps=3)
    file = tmp_path / "trial.gif"
    movie.save(file, writer=PillowWriter(fps=3), dpi=90)
    with Image.open(file) as image:
        # The writer merges equal frames: those of the last second.
        assert image.n_frames >= 4
        first = np.asarray(image.convert("L"), float)
        image.seek(3)
        assert np.abs(np.asarray(image.convert("L"), float) - first).max() > 50
    with pytest.raises(ValueError, match="headings=<3>"):
        plots.plot_trial(params, path, np.zeros(3))
    shifted = plots._shapes(params, 2)[0][0] - plots._shapes(params, 0)[0][0]
    np.testing.assert_allclose(shifted, np.tile([40.0, 0.0], (3, 1)), atol=1e-4)
    assert jnp.asarray(params.patrol_steps) == 5
