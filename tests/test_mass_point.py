# SPDX-License-Identifier: Apache-2.0
"""Feasible regions of the mass point, against what can be worked out by hand."""

import importlib.util
import json
import sys
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pytest

_FOLDER = Path(__file__).parents[1] / "experiments"
_PATH = _FOLDER / "mass_point.py"
_SPEC = importlib.util.spec_from_file_location("mass_point", _PATH)
assert _SPEC and _SPEC.loader
mass_point = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(mass_point)


def _slice(region, time: float) -> np.ndarray:
    return region.events[round(time / region.dt)]


def test_the_region_without_bounds_is_the_known_one():
    """Fastest: a for half of the time, then -a: 2.5 m/s x ... ; furthest: a T^2 / 16 = 3.125 m."""
    region = mass_point.feasible((), 60)
    speeds = np.abs(region.v[region.events.any((0, 2))])
    places = np.abs(region.x[region.events.any((0, 1))])
    assert speeds.max() == pytest.approx(2.5, abs=2 * (region.v[1] - region.v[0]))
    assert places.max() == pytest.approx(3.125, rel=0.02)


def test_what_is_reached_from_rest_has_the_area_of_the_bang_bang_curves():
    """2/3 a^2 t^3: the lens between full speed ahead, then back, and the other way round."""
    admitted = np.ones((31, 67, 4001), bool)
    admitted[0] = False
    admitted[0, 33, 2000] = True
    reached = mass_point._reach(admitted, forward=True)
    for steps in (10, 20, 30):
        cells = reached[steps].sum()  # of a lattice with a dt = 1, a dt^2 / 2 = 1/2, step 1
        assert cells == pytest.approx(2 / 3 * steps**3, rel=0.2)


def test_time_can_be_turned_round():
    """e1 and e2 are alike, so a region without bounds is its own mirror image: v changes sign."""
    events = mass_point.feasible((), 30).events
    np.testing.assert_array_equal(events, events[::-1, ::-1])
    np.testing.assert_array_equal(events, events[:, ::-1, ::-1])


def test_bounds_are_kept_and_every_event_goes_on():
    region = mass_point.feasible((mass_point.B1, mass_point.B2), 60)
    for bound in (mass_point.B1, mass_point.B2):
        v, x = np.nonzero(_slice(region, bound.time))
        assert bound.x[0] <= region.x[x].min() and region.x[x].max() <= bound.x[1]
        assert bound.v[0] <= region.v[v].min() and region.v[v].max() <= bound.v[1]
    assert region.events.any((1, 2)).all()


def test_each_bound_shrinks_the_region():
    volumes = [mass_point.feasible(bounds, 30).volume for bounds in mass_point.CASES.values()]
    assert volumes[0] > 1.8 * volumes[1] > 1.8 * 3.0 * volumes[2]


def test_the_notebook_runs_and_prints_what_it_shows(monkeypatch: pytest.MonkeyPatch, capsys):
    """Its cells, one after the other; what they print is what is kept in it."""
    folder = _FOLDER / "notebooks"
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    cells = json.loads((folder / "mass_point.ipynb").read_text())["cells"]
    cells = [cell for cell in cells if cell["cell_type"] == "code"]
    scope: dict = {}
    with matplotlib.rc_context({"backend": "agg"}), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a picture cannot be shown
        for cell in cells:
            exec("".join(cell["source"]), scope)
    kept = [out["text"] for cell in cells for out in cell["outputs"] if "text" in out]
    shown = "".join(text if isinstance(text, str) else "".join(text) for text in kept)
    assert capsys.readouterr().out == shown
