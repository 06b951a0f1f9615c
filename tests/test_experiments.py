# SPDX-License-Identifier: Apache-2.0
"""The figures of the README are those of the files under experiments/results."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import jax
import pytest

from jaxskills import cli, physics, provenance, trainer

ROOT = Path(__file__).parents[1]


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "experiments" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def scripts_see_each_other(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")


RECORD = {
    "command": "jaxskills train walk",
    "skill": "walk",
    "seed": 2,
    "samples": 1_234_000,
    "wall_s": 90.0,
    "evaluate": {"success_rate": 0.984375, "episodes": 64},
    "evaluate_600hz": None,
    "processor": "Abacus",
    "cores": 2,
    "backend": "cpu",
}


def test_a_row_of_the_table():
    row = script("tables").row(RECORD)
    assert row == "| walk | 2 | 1.23 M | 4.08 M | 1.5 | 98.4% of 64 | failed |"


def test_records_come_in_order(tmp_path: Path):
    for skill, seed in (("walk", 10), ("run", 1), ("walk", 9)):
        text = json.dumps(RECORD | {"skill": skill, "seed": seed})
        (tmp_path / f"{skill}-{seed}.json").write_text(text)
    found = script("tables").records(tmp_path)
    assert [(r["skill"], r["seed"]) for r in found] == [("run", 1), ("walk", 9), ("walk", 10)]


@pytest.mark.parametrize("readme", ["README.md", "experiments/README.md"])
def test_the_readme_shows_the_records(readme: str):
    tables = script("tables")
    block = tables.BLOCK.search((ROOT / readme).read_text())
    assert block and tables.PAGES[block[2]]() in block[0]


def test_a_comparison_table():
    curve = [{"samples": 1e6, "success_rate": 0.5}, {"samples": 2e6, "success_rate": 0.97}]
    found = {"success_rate": 0.984375, "episodes": 64, "seconds_mean": 19.5}
    style = {"command": "jaxskills train run_style --samples 1", "curve": curve}
    measured = found | {"energy_mean": 61.23, "volume_mean": 0.0512}
    cases = {
        "plain": RECORD | {"curve": curve[:1], "evaluate": measured},
        "like": RECORD | style | {"evaluate": measured, "gram_distances": {"happy_walk": 0.876}},
    }
    lines = script("tables").comparison(cases).splitlines()
    assert lines[0].endswith(
        "| mean time | distance from happy_walk | energy, J | hull volume, l |"
    )
    assert lines[2] == "| plain | 1.23 M | never | 2 | 98% of 64 | 19.5 s |  |  |  |"
    assert lines[3] == "| like | 1.23 M | 2.00 M | 2 | 98% of 64 | 19.5 s | 0.88 | 61.2 | 51.2 |"


def test_each_comparison_can_be_trained():
    """Its skills are recipes, and its options are options of `train`."""
    for name, cases in script("compare").COMPARISONS.items():
        for label, case in cases.items():
            command = ["train", case.skill, "--out", "nowhere", *case.options]
            _, config = cli.parse(command)
            assert config.samples < 50e6, (name, label)
            trainer.validate(config)


def test_deepmimic_is_imitation_until_a_fall_without_anything_of_ours():
    case = script("compare").COMPARISONS["sparse_jog"]["deepmimic"]
    _, config = cli.parse(["train", case.skill, "--out", "nowhere", *case.options])
    env = config.env
    assert (env.reward, env.stop, env.feedforward) == ("imitation", "fall", False)
    assert config.starts.uniform == 1.0 and not config.evolution.enabled


@pytest.mark.parametrize("count", [1, 39, 40, 1000])
def test_a_thinned_curve_keeps_its_ends_and_its_evaluations(count: int):
    rows = [{"samples": i} | ({"success_rate": 0.5} if i == 7 else {}) for i in range(count)]
    kept = script("reproduce").thinned(rows)
    assert kept[0] is rows[0] and kept[-1] is rows[-1]
    assert count <= 7 or rows[7] in kept
    assert len(kept) <= 2 * 40 + 2


def test_where_a_record_was_made(tmp_path: Path):
    found = provenance.describe(tmp_path)
    assert found["versions"]["jax"] == jax.__version__
    assert found["cores"] >= 1 and found["processor"] and found["device"]
    assert found["backend"] in physics.BACKENDS
    assert found["commit"] == ""  # not a checkout
