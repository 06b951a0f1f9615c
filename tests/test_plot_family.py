# SPDX-License-Identifier: Apache-2.0
"""Pictures of a family: what the axes hold, and the page for one, two and more parameters."""

from pathlib import Path

import numpy as np
import pytest
import tiny_family
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from jaxskills.errors import UserError
from jaxskills.plot import family as plot_family
from jaxskills.plot.family import Asked, Explored

METRICS = [
    tiny_family.line(1, base_learnt=False, marginal=0.1),
    tiny_family.line(2),
    tiny_family.line(3, marginal=0.4),
    tiny_family.line(4, refining=True),
]
NAMES = ("energy", "gravity", "length", "width")


def _explored(count: int, elites: int = 5) -> Explored:
    places = {1: [(0,)], 2: [(0, 1)]}.get(count, [(0, 1), (0, 2), (1, 2)])
    shape = (32,) if count == 1 else (8, 8)
    share = np.linspace(0.0, 1.0, elites)[:, None] * np.ones(count)
    return Explored(
        names=NAMES[:count],
        ranges=np.array([[0.8, 1.8], [0.2, 1.6], [1.0, 2.0], [1.0, 1.5]])[:count],
        elites=np.array([0.8, 0.2, 1.0, 1.0])[:count] + share,
        fitness=np.linspace(0.4, 0.9, elites),
        level=0.8,
        maps={place: np.random.default_rng(0).uniform(size=shape) for place in places},
    )


ASKED = Asked(
    ("energy",),
    np.array([[0.8], [1.2], [1.8]]),
    np.array([[0.9], [np.nan], [1.7]]),
    np.array([True, False, True]),
)


@pytest.fixture
def axes() -> Axes:
    return Figure().add_subplot()


def _dots(axes: Axes) -> np.ndarray:
    found = [x for x in axes.collections if isinstance(x, PathCollection)]
    return np.asarray(found[0].get_offsets())


def test_the_curriculum_is_shaded_by_phase(axes: Axes):
    plot_family.curriculum(METRICS, axes)
    spans = [(patch.get_x(), patch.get_width()) for patch in axes.patches]  # type: ignore
    assert spans == [(0.5, 1.0), (1.5, 2.0), (3.5, 1.0)]
    around = axes.lines[0]
    np.testing.assert_array_equal(around.get_ydata(), [np.nan, 0.3, 0.3, 0.3])
    right = axes.figure.axes[1]
    np.testing.assert_array_equal(right.lines[0].get_ydata(), [np.nan, 0.2, 0.4, 0.2])
    legend = axes.get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:3] == ["the reference alone", "exploration", "refinement"]
    assert texts[-1] == "mean marginal value" and len(texts) == 6


def test_density_in_a_plane(axes: Axes):
    seen = _explored(2)
    plot_family.density(seen, (0, 1), axes)
    image = axes.images[0]
    np.testing.assert_array_equal(image.get_array(), seen.maps[0, 1])
    assert list(image.get_extent()) == [0.8, 1.8, 0.2, 1.6] and image.origin == "lower"
    np.testing.assert_array_equal(_dots(axes), seen.elites)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("energy", "gravity")
    assert axes.get_title(loc="left") == "5 elites and their density"


def test_density_along_one_parameter(axes: Axes):
    seen = _explored(1)
    plot_family.density(seen, (0,), axes)
    curve = axes.lines[0]
    np.testing.assert_array_equal(curve.get_ydata(), seen.maps[(0,)])
    assert (curve.get_xdata()[0], curve.get_xdata()[-1]) == (0.8, 1.8)  # type: ignore[index]
    np.testing.assert_array_equal(axes.lines[2].get_xdata(), seen.elites[:, 0])


@pytest.mark.parametrize("count", [1, 2])
def test_fitness_of_the_elites(count: int, axes: Axes):
    seen = _explored(count)
    plot_family.fitness(seen, tuple(range(count)), axes)
    if count == 1:
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), seen.fitness)
    else:
        np.testing.assert_array_equal(_dots(axes), seen.elites)
        np.testing.assert_array_equal(axes.collections[0].get_array(), seen.fitness)
    assert axes.get_title(loc="left") == "Fitness of the elites, 0.65 in the mean"


def test_explored_over_episodes(axes: Axes):
    plot_family.ratio(METRICS, axes)
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [0.6, 1.2, 1.8, 2.4])
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [10, 20, 30, 40])
    assert axes.get_title(loc="left") == "40% explored"


def test_quality_of_the_episodes(axes: Axes):
    plot_family.quality([*METRICS, tiny_family.line(5, task_error=0.25)], axes)
    found = {str(line.get_label()): list(np.asarray(line.get_ydata())) for line in axes.lines}
    assert found["share that got through"] == [0.5] * 5 and found["fitness"] == [0.7] * 5
    assert found["error of the task, of its range"][-1] == 0.25


def test_measured_against_asked(axes: Axes):
    plot_family.met(ASKED, 0, axes)
    np.testing.assert_array_equal(_dots(axes), [[0.8, 0.9], [1.8, 1.7]])
    assert axes.get_title(loc="left") == "energy: 2 of 3 got through, red: falls"
    assert [line.get_xdata()[0] for line in axes.lines[1:]] == [1.2]  # type: ignore[index]


@pytest.mark.parametrize(("count", "elites"), [(1, 5), (2, 0), (4, 5)])
def test_page(count: int, elites: int, tmp_path: Path):
    asked = ASKED if count == 4 else None
    path = plot_family.figure(
        tmp_path / "new" / "page.png", "jumps", METRICS, _explored(count, elites), asked
    )
    with Image.open(path) as page:
        assert page.width == 1650 and np.asarray(page.convert("L")).std() > 5
    if elites == 0:
        figure = Figure()
        plot_family.fitness(_explored(2, 0), (0, 1), figure.add_subplot())
        assert "no elites yet" in [text.get_text() for text in figure.findobj(Text)]


@pytest.mark.parametrize(
    ("name", "metrics", "says"),
    [
        ("a.jpg", METRICS, "unknown picture format '.jpg'"),
        ("a.png", [], "metrics.jsonl has no lines yet"),
        ("a.png", [{"samples": 1}], "line 1 of metrics.jsonl lacks episodes, explored"),
    ],
)
def test_what_cannot_be_drawn(name: str, metrics: list, says: str, tmp_path: Path):
    with pytest.raises(UserError) as raised:
        plot_family.figure(tmp_path / name, "jumps", metrics, _explored(1))
    assert says in str(raised.value)
