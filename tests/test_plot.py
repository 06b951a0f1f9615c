# SPDX-License-Identifier: Apache-2.0
"""Plots: what the axes hold, read back from matplotlib, and the page as a picture."""

import dataclasses
import subprocess
import sys

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from jaxskills import plot
from jaxskills.errors import UserError
from jaxskills.plot import starts

METRICS = [
    {"samples": 1e6, "wall_s": 60.0, "survival_s": 0.5, "ended/com_z": 0.75, "ended/root": 0.25},
    {"samples": 2e6, "wall_s": 120.0, "survival_s": 2.0, "ended/com_z": 1.0, "seconds_mean": 5.0},
    {"samples": 4e6, "wall_s": 300.0, "survival_s": 6.0, "ended/neck": 1.0},
]


@pytest.fixture
def axes() -> Axes:
    return Figure().add_subplot()


def _lines(axes: Axes) -> dict[str, np.ndarray]:
    return {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.lines}


def _texts(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_learning_curve(axes):
    plot.learning_curve(METRICS, axes)
    lines = _lines(axes)
    assert np.array_equal(lines["training, until a bound"], [[1, 0.5], [2, 2.0], [4, 6.0]])
    assert np.array_equal(lines["test, until a fall"], [[2, 5.0]])
    assert set(lines) == {"training, until a bound", "test, until a fall"}
    assert axes.get_title(loc="left") == "Learning curve: 4 million samples, 5 min"
    assert axes.get_ylim()[0] == 0 and "(s)" in axes.get_ylabel()


def test_learning_curve_with_adaptive_bounds(axes):
    rows = [
        row | {"bound_scale": scale} for row, scale in zip(METRICS, (1.0, 1.2, 0.9), strict=True)
    ]
    plot.learning_curve(rows, axes)
    _, right = axes.figure.axes
    assert np.array_equal(right.lines[0].get_xydata(), [[1, 1.0], [2, 1.2], [4, 0.9]])
    assert right.get_ylabel() == "scale of the bounds" and right.get_ylim()[0] == 0


def test_a_run_without_failures_does_not_flatten_the_learning_curve(axes):
    plot.learning_curve([*METRICS, {"samples": 5e6, "wall_s": 400.0, "survival_s": 341.0}], axes)
    assert axes.get_ylim() == (0.0, 25.0)


def test_causes_stack_to_the_whole(axes):
    plot.causes(METRICS, axes)
    assert _texts(axes) == ["root", "neck", "com_z"]  # the largest at the bottom
    tops = [band.get_paths()[0].vertices for band in axes.collections]
    assert max(top[:, 1].max() for top in tops) == pytest.approx(100.0)
    bottom = tops[0]
    assert bottom[np.isclose(bottom[:, 0], 1.0), 1].max() == pytest.approx(75.0)
    assert bottom[:, 0].min() == 0.0


def test_causes_before_any_episode_has_ended(axes):
    plot.causes([{"samples": 10, "wall_s": 1.0, "survival_s": 0.0}], axes)
    assert [text.get_text() for text in axes.texts] == ["no episode has ended yet"]


def test_causes_keep_the_largest_and_sum_the_rest(axes):
    shares = {f"ended/b{i}": 0.01 * (i + 1) for i in range(13)}
    plot.causes([{"samples": 1e6, "wall_s": 1.0, "survival_s": 1.0, **shares}], axes)
    assert _texts(axes) == ["7 others", "b7", "b8", "b9", "b10", "b11", "b12"]
    others = axes.collections[-1].get_paths()[0].vertices
    assert np.ptp(others[:, 1]) == pytest.approx(100 * sum(0.01 * (i + 1) for i in range(7)))


def test_com_height_is_fig_5(axes):
    phase, height = np.array([0.1, 0.5, 0.9]), np.array([0.9, 1.0, 0.95])
    plot.com_height(phase, height, np.array([0.0, 1.0]), np.array([0.9, 1.0]), 0.2, axes)
    lines = {line.get_color(): line for line in axes.lines}
    green = [line for colour, line in lines.items() if _hue(colour) == "green"]
    assert np.array_equal(np.asarray(green[0].get_ydata()), [0.9, 1.0])
    red = [np.asarray(line.get_ydata()) for line in axes.lines if _hue(line.get_color()) == "red"]
    assert np.allclose(sorted(y[0] for y in red), [0.7, 1.1])
    dots = next(c for c in axes.collections if isinstance(c, PathCollection))
    assert np.array_equal(dots.get_offsets(), np.stack([phase, height], 1))
    assert _hue(dots.get_facecolor()[0]) == "blue"
    assert _texts(axes) == ["learnt", "reference", "bounds"]


def _hue(colour) -> str:
    return ("red", "green", "blue")[int(np.argmax(matplotlib.colors.to_rgb(colour)))]


def test_com_height_within_bounds_over_phase(axes):
    grid = np.array([0.0, 0.5, 1.0])
    bound = np.array([0.1, 0.3, np.nan])  # open at the end
    plot.com_height(grid, 0 * grid, grid, 0 * grid, bound, axes)
    red = [np.asarray(line.get_ydata()) for line in axes.lines if _hue(line.get_color()) == "red"]
    np.testing.assert_array_equal(red, [-bound, bound])
    assert np.isfinite(axes.get_ylim()).all()


def test_com_height_thins_out_very_many_dots(axes):
    many = np.linspace(0, 1, 100_001)
    plot.com_height(many, many, many[:2], many[:2], 0.2, axes)
    dots = next(c for c in axes.collections if isinstance(c, PathCollection))
    assert 10_000 < len(np.asarray(dots.get_offsets())) <= 20_000


def test_margins_show_mean_and_worst_of_the_tightest(axes):
    phase = np.array([0.001, 0.002, 0.999])
    by_bound = {
        "wide": np.array([0.9, 0.9, 0.9]),
        "tight": np.array([0.4, 0.2, -0.1]),
    }
    plot.margins(phase, by_bound, axes, shown=1)
    assert _texts(axes) == ["tight"]
    mean = _lines(axes)["tight"]
    assert np.allclose(mean[:, 1], [0.3, -0.1])
    assert mean[0, 0] < 0.05 and mean[1, 0] > 0.95
    worst = [np.asarray(line.get_ydata()) for line in axes.lines if line.get_linestyle() == "--"]
    assert np.allclose(worst, [[0.2, -0.1]])
    assert any(np.array_equal(line.get_ydata(), [0, 0]) for line in axes.lines)  # the bound


def test_regions_show_least_mean_and_largest_of_every_bound():
    phase = np.array([0.001, 0.002, 0.999])
    by_bound = {f"b{i}": np.array([0.4, 0.2, 0.1 * i]) for i in range(6)}
    by_bound["left"] = np.array([0.9, 0.5, -0.25])
    page = Figure()
    plot.regions(phase, by_bound, page)
    shown = [axes for axes in page.axes if axes.get_visible()]
    titles = [axes.get_title(loc="left") for axes in shown]
    assert titles[0] == "b0  0.00" and titles[2:] == [
        *(f"b{i}  0.20" for i in range(2, 6)),
        "left  -0.25",
    ]
    band, mean = shown[-1].collections[0].get_paths()[0].vertices, shown[-1].lines[0]
    assert {0.9, 0.5, -0.25} == set(np.asarray(band)[:, 1])
    np.testing.assert_allclose(np.asarray(mean.get_ydata()), [0.7, -0.25])
    np.testing.assert_allclose(np.asarray(mean.get_xdata()), [0.0125, 0.9875])
    colours = {text.get_text(): text.get_color() for text in page.findobj(Text)}
    assert [title for title in titles if colours[title] != "black"] == ["left  -0.25"]


def test_training_endings_are_summed_over_the_lines(axes):
    rows = [dict(line) for line in METRICS]
    rows[0]["endings"] = {"com_z": [1, 0, 2], "root": [0, 0, 1]}
    rows[2]["endings"] = {"com_z": [1, 0, 0], "neck": [0, 0, 0]}
    plot.training_endings(rows, axes)
    assert np.array_equal(np.asarray(axes.images[0].get_array()), [[2, 0, 2], [0, 0, 1]])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["com_z (4)", "root (1)"]
    assert axes.get_title(loc="left") == "Where 5 training episodes ended"


def test_training_endings_of_a_run_that_did_not_record_them(axes):
    plot.training_endings(METRICS, axes)
    assert [text.get_text() for text in axes.texts] == ["not recorded"]


def test_endings_map(axes):
    counts = {"com_z": np.array([0, 2, 1]), "root": np.array([5, 0, 0]), "neck": np.zeros(3)}
    plot.endings(counts, axes)
    assert np.array_equal(np.asarray(axes.images[0].get_array()), [[5, 0, 0], [0, 2, 1]])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["root (5)", "com_z (3)"]
    assert axes.get_title(loc="left") == "Where 8 tested episodes left the bounds"


def test_endings_where_there_were_none(axes):
    plot.endings({"com_z": np.zeros(3)}, axes)
    assert not axes.images
    assert [text.get_text() for text in axes.texts] == ["none did"]


PLAYED = plot.Played(
    phase=np.linspace(0, 1, 50),
    height=np.full(50, 0.9),
    reference_phase=np.array([0.0, 1.0]),
    reference_height=np.array([0.9, 0.9]),
    bound=np.array([0.2, 0.2]),
    margins={"com_z": np.linspace(0, 1, 50), "root": np.full(50, 0.5)},
    endings={"com_z": np.array([1, 2]), "root": np.array([0, 1])},
)


# Two bodies; the starts are off the reference by (0.03, 0.04, 0) m and by nothing, then by nothing.
EVOLVED = plot.Evolved(
    phase=np.array([0.25, 0.75]),
    places=np.array([[1.03, 0.04, 0, 2, 0, 0], [3, 0, 0, 4, 0, 0.0]]),
    at_phase=np.array([[1.0, 0, 0, 2, 0, 0], [3, 0, 0, 4, 0, 0]]),
    reference_phase=np.array([0.0, 0.5, 1.0]),
    reference=np.array([[0.0, 0, 0, 1, 0, 0], [2, 0, 0, 3, 0, 0], [4, 0, 0, 5, 0, 0]]),
)


def test_distance_of_evolved_starts(axes):
    starts.distance(EVOLVED, axes)
    dots = np.asarray(axes.collections[0].get_offsets())
    np.testing.assert_allclose(dots, [[0.25, 5.0 / np.sqrt(2.0)], [0.75, 0.0]], atol=1e-12)
    assert axes.get_title(loc="left").startswith("Evolved starts are 1.8 cm from")


def test_first_component_of_evolved_starts_is_fig_13(axes):
    """All lies along (1, 0, 0, 1, 0, 0), so a step of 1 m of both bodies is one of sqrt 2."""
    evolved = dataclasses.replace(EVOLVED, places=EVOLVED.at_phase)
    starts.component(evolved, axes)
    blue, green = (np.asarray(dots.get_offsets()) for dots in axes.collections)
    np.testing.assert_allclose(blue[:, 0], [0.25, 0.75])
    np.testing.assert_allclose(blue[:, 1], np.sqrt(2.0) * np.array([-1.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(green[:, 1], np.sqrt(2.0) * np.array([-2.0, 0, 2]), atol=1e-12)
    assert [_hue(c.get_facecolor()[0]) for c in axes.collections] == ["blue", "green"]
    assert "(100% of what varies)" in axes.get_title(loc="left")


def test_page_of_a_run_whose_starts_evolve(tmp_path):
    path = plot.figure(tmp_path / "walk.png", "walk", METRICS, None, EVOLVED)
    page = np.asarray(Image.open(path).convert("L"), float)
    assert page.shape[0] > 1000
    assert all((half < 128).mean() > 0.005 for half in np.array_split(page, 2))


def test_page(tmp_path):
    path = plot.figure(tmp_path / "new" / "walk.png", "walk", METRICS, PLAYED)
    full = np.asarray(Image.open(path).convert("L"), float)
    short = np.asarray(
        Image.open(plot.figure(tmp_path / "short.png", "walk", METRICS, None)).convert("L"), float
    )
    assert full.shape[1] == short.shape[1] == 11 * 150
    assert full.shape[0] > 2 * short.shape[0]
    # Each of the three rows holds ink: one row of pictures is a third of the page.
    thirds = np.array_split(full, 3)
    assert all((third < 128).mean() > 0.005 for third in thirds)


def test_page_without_tested_endings(tmp_path):
    none = dataclasses.replace(PLAYED, endings={"com_z": np.zeros(4)})
    assert plot.figure(tmp_path / "walk.svg", "walk", METRICS[:1], none).stat().st_size > 1000


@pytest.mark.parametrize(
    ("path", "metrics", "message"),
    [
        ("a.jpeg", METRICS, "unknown picture format '.jpeg': choose one of .png, .pdf, .svg"),
        ("a.png", [], "there is nothing to plot: metrics.jsonl has no lines yet"),
        ("a.png", [METRICS[0], {"samples": 1}], "line 2 of metrics.jsonl lacks wall_s, survival_s"),
    ],
)
def test_bad_input_is_named(tmp_path, path, metrics, message):
    with pytest.raises(UserError, match=f"^{message}$"):
        plot.figure(tmp_path / path, "walk", metrics, None)


def test_no_window_is_opened():
    """Neither pyplot nor a toolkit is loaded, whatever MPLBACKEND says."""
    program = "import sys; from jaxskills import plot; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "False\n")
