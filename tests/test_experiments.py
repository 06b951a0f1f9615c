# SPDX-License-Identifier: Apache-2.0
"""The figures of the README are those of the files under experiments/results."""

import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType

import jax
import pytest

from jaxskills import cli, clip, families, physics, provenance, recipes, trainer

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
    assert row == "| walk | 2 | 1.23 M | 4.08 M | 1.5 | 2 | 98.4% of 64 | failed |"


def test_records_come_in_order(tmp_path: Path):
    for skill, seed in (("walk", 10), ("run", 1), ("walk", 9)):
        text = json.dumps(RECORD | {"skill": skill, "seed": seed})
        (tmp_path / f"{skill}-{seed}.json").write_text(text)
    found = script("tables").records(tmp_path)
    assert [(r["skill"], r["seed"]) for r in found] == [("run", 1), ("walk", 9), ("walk", 10)]


@pytest.mark.parametrize("readme", ["README.md", "experiments/README.md"])
def test_the_readme_shows_the_records(readme: str):
    tables = script("tables")
    blocks = list(tables.BLOCK.finditer((ROOT / readme).read_text()))
    assert blocks
    for block in blocks:
        assert tables.PAGES[block[2]]() in block[0]


def test_a_comparison_table():
    curve = [{"samples": 1e6, "success_rate": 0.5}, {"samples": 2e6, "success_rate": 0.97}]
    found = {"success_rate": 0.984375, "episodes": 64, "seconds_mean": 19.5}
    style = {"command": "jaxskills train run_style --samples 1", "curve": curve}
    off = {"joint_error_mean": 0.1, "com_error_mean": 0.0312}
    measured = found | {"energy_mean": 61.23, "volume_mean": 0.0512}
    cases = {
        "plain": RECORD | {"curve": curve[:1], "evaluate": measured | off},
        "like": RECORD | style | {"evaluate": measured, "gram_distances": {"happy_walk": 0.876}},
        "unasked": RECORD | {"curve": [{"samples": 1e6}], "evaluate": found},
    }
    lines = script("tables").comparison(cases).splitlines()
    heads = "| joints off | CoM off | distance from happy_walk | energy, J | hull volume, l |"
    assert lines[0].endswith(f"| mean time {heads}")
    begin = "| 1.23 M |", "| 2 | 98% of 64 | 19.5 s |"
    assert lines[2] == f"| plain {begin[0]} never {begin[1]} 5.7° | 3.1 cm |  |  |  |"
    assert lines[3] == f"| like {begin[0]} 2.00 M {begin[1]}  |  | 0.88 | 61.2 | 51.2 |"
    assert lines[4] == f"| unasked {begin[0]}  {begin[1]}  |  |  |  |  |"


FAMILY = RECORD | {
    "skill": "pivot_family",
    "seed": 0,
    "curve": [
        {"samples": 1, "episodes": 20_000, "explored": 0.5, "success": 0.9},
        {"samples": 2, "episodes": 46_200, "explored": 0.93, "success": 0.9},
    ],
    "evaluate": {
        "success_rate": 0.98,
        "episodes": 50,
        "errors": {
            "rotation": {"mean": 0.0312, "p95": 0.08, "relative": True, "share": 0.0312},
            "angle": {"mean": 0.0312, "p95": 0.08, "relative": False, "share": 0.0104},
        },
        "explored_ranges": {"rotation": [0.725, 1.3], "angle": None},
    },
}


def test_a_row_of_the_table_of_families():
    tables = script("family_tables")
    assert tables.is_family(FAMILY) and not tables.is_family(RECORD)
    assert tables.row(FAMILY) == (
        "| pivot | 0 | 0.046 M | 0.120 M | 0.93 | 1.00 | 98% of 50 | failed"
        " | rotation 3.1%, angle 1.0% | 2 |"
    )
    assert tables.table([FAMILY]).splitlines()[1].count("---") == 10


def test_a_comparison_of_families():
    tables = script("family_tables")
    failed = FAMILY | {"evaluate": None, "curve": FAMILY["curve"][:1]}
    lines = tables.comparison({"A1": failed, "A3": FAMILY}).splitlines()
    assert lines[0].endswith("| explored angle | explored rotation | minutes |")
    assert lines[2] == "| A1 | 0.020 M | 0.50 | never | failed |  | nothing | nothing | 2 |"
    assert lines[3] == (
        "| A3 | 0.046 M | 0.93 | 0.046 M | 98% of 50 | rotation 3.1%, angle 1.0%"
        " | nothing | 0.72 to 1.30 | 2 |"
    )


def test_families_have_a_table_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tables = script("tables")
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    for record in (RECORD, FAMILY):
        path = tmp_path / f"{record['skill']}-{record['seed']}.json"
        path.write_text(json.dumps(record))
    assert "pivot" not in tables.trainings() and "| walk |" in tables.trainings()
    assert "| pivot |" in tables.families() and "walk" not in tables.families()
    for label in ("A1", "A3"):
        (tmp_path / "jump_ablation").mkdir(exist_ok=True)
        (tmp_path / "jump_ablation" / f"{label}.json").write_text(json.dumps(FAMILY))
    assert "90 % explored after" in tables.comparisons()


def _curve(*seconds: float) -> list[dict[str, float]]:
    rows = [{"samples": 1_000_000 * (i + 1), "survival_s": s} for i, s in enumerate(seconds)]
    return [*rows[:-1], {**rows[-1], "success_rate": 0.97}]


def test_curves_begin_where_the_training_before_has_ended():
    """The first update is left out: hardly an episode has ended in it."""
    plain = RECORD | {"samples": 3_000_000, "curve": _curve(9.0, 1.0, 2.0)}
    styled = RECORD | {"samples": 3_000_000, "curve": _curve(9.0, 15.0, 40.0)}
    cases = {"plain": plain, "energy_up": styled}
    page = script("curves").comparison("cartwheel_styles", cases)
    first, _, second, passed = (line.get_xydata() for line in page.axes[0].lines)
    assert first[:, 0].tolist() == [2.0, 3.0] and second[:, 0].tolist() == [5.0, 6.0]
    assert first[:, 1] == pytest.approx([2 ** (1 / 3), 2 ** (2 / 3)])  # means of three, of the logs
    assert passed.tolist() == [[6.0, 20.0]]  # episodes end after 20 s


def test_curves_of_a_folder(tmp_path: Path):
    curves, record = script("curves"), RECORD | {"curve": _curve(1.0, 2.0, 4.0)}
    (tmp_path / "walk-2.json").write_text(json.dumps(record))
    (tmp_path / "feedforward").mkdir()
    (tmp_path / "feedforward" / "with.json").write_text(json.dumps(record))
    assert curves.draw(tmp_path) == [tmp_path / "curves.png"]  # one case is no comparison
    (tmp_path / "feedforward" / "without.json").write_text(json.dumps(record))
    drawn = curves.draw(tmp_path)
    assert [path.parent.name for path in drawn] == [tmp_path.name, "feedforward"]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in drawn)


def test_the_families_of_the_paper():
    """Every row of FS Table 1 has its most samples; a recipe that is there is a family."""
    paper, most = script("family_tables").PAPER, script("fs_table1").SAMPLES
    assert set(paper) == {f"{skill}_family" for skill in most} and len(paper) == 13
    there = [name for name in paper if name in recipes.names()]
    assert "pivot_family" in there
    for name in there:
        assert recipes.task(name).free


def test_steps_of_an_episode():
    """The pivot lasts as long as its clip, then its last pose is held for half a second."""
    seconds = clip.load("pivot").duration
    assert script("fs_table1").steps("pivot_family") == math.ceil(30 * seconds - 1e-6) + 15


def test_the_ablations_are_what_they_are_called():
    cases = script("compare").COMPARISONS["jump_ablation"]
    found = {}
    for label, case in cases.items():
        _, config = cli.parse(["train", case.skill, "--out", "nowhere", *case.options])
        found[label] = config.family.vary, config.env.time_warp
        assert config.family.curriculum.method == "fixed_alternation"
    assert found == {"A1": (False, False), "A2": (True, False), "A3": (True, True)}
    task = recipes.task("jump_gravity_family")
    assert [p.name for p in task.free] == ["gravity"]
    assert {p.name for p in task.parameters if p.fixed} == {"energy", "foot_contact"}


def test_a_clip_that_is_not_there_is_missed_before_training(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    compare = script("compare")
    monkeypatch.delenv("JAXSKILLS_CLIP_DIR", raising=False)
    monkeypatch.setattr("sys.argv", ["compare.py", "run_styles", "--runs", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        compare.main()
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1
    assert "run_styles: unknown clip 'happy_walk'" in error
    assert not list(tmp_path.iterdir())


def test_each_comparison_can_be_trained():
    """Its skills are recipes, and its options are options of `train`."""
    for name, cases in script("compare").COMPARISONS.items():
        for label, case in cases.items():
            command = ["train", case.skill, "--out", "nowhere", *case.options]
            _, config = cli.parse(command)
            assert config.samples < 50e6, (name, label)
            first, _, other = case.after.partition("/")
            assert not other or not script("compare").COMPARISONS[first][other].after
            (families if config.task else trainer).validate(config)


def test_the_same_training_is_done_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The walk of two comparisons, and one beside it that is another training."""
    made, done = script("compare"), []
    plain, other = made.Case("walk", ("--samples", "9")), made.Case("walk", after="a/x")
    monkeypatch.setattr(made, "COMPARISONS", {"a": {"x": plain}, "b": {"y": plain, "z": other}})
    monkeypatch.setattr(made, "RESULTS", tmp_path)
    monkeypatch.setattr("sys.argv", ["compare.py", "a", "b", "--runs", str(tmp_path / "runs")])

    def train(skill: str, seed: int, run: Path, options: tuple[str, ...]) -> dict:
        done.append((run.name, options))
        run.mkdir(parents=True)
        (run / "walk.png").write_text(run.name)
        return {"made": run.name}

    monkeypatch.setattr(made, "reproduce", train)
    made.main()
    begin = "--init-from", str(tmp_path / "runs" / "a" / "x")
    assert done == [("x", plain.options), ("z", begin)]
    found = [json.loads((tmp_path / path).read_text())["made"] for path in ("a/x.json", "b/y.json")]
    assert found == ["x", "x"]
    assert [(tmp_path / f"b/{label}.png").read_text() for label in "yz"] == ["x", "z"]
    made.main()
    assert len(done) == 2


@pytest.mark.parametrize(
    ("changed", "taken"),
    [
        ({}, True),
        ({"samples": 11}, False),  # more than the case may have
        ({"curve": [{"fine_success_rate": 0.9}]}, False),  # not learnt
        ({"processor": "another"}, False),
    ],
)
def test_the_record_of_a_recipe_serves_as_a_case(
    changed: dict, taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = script("compare")
    monkeypatch.setattr(made, "RESULTS", tmp_path)
    here = made.provenance.describe(tmp_path)
    record = {**here, "samples": 9, "curve": [{}, {"fine_success_rate": 1.0}], **changed}
    (tmp_path / "walk-0.json").write_text(json.dumps(record))
    (tmp_path / "walk.png").write_text("strip")
    found = made.plain(made.Case("walk", ("--samples", "10")))
    assert [path.name for path in found] == (["walk-0.json", "walk.png"] if taken else [])
    assert made.plain(made.Case("walk", ("--samples", "10", "--starts.uniform", "1"))) == []
    assert made.plain(made.Case("run", ("--samples", "10"))) == []


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


def test_an_interrupted_training_is_not_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = script("reproduce")
    monkeypatch.setattr(made, "train", lambda options: (130, 1.0, None))
    with pytest.raises(SystemExit, match="130"):
        made.reproduce("walk", 0, tmp_path)


def test_a_record_names_no_folder_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = script("reproduce")
    monkeypatch.setattr(made, "train", lambda options: (0, 1.0, None))
    monkeypatch.setattr(made, "jaxskills", lambda *options: "")
    run = tmp_path / "some" / "like"
    run.mkdir(parents=True)
    (run / "metrics.jsonl").write_text('{"samples": 5, "wall_s": 1.0}\n')
    record = made.reproduce("run", 0, run, ("--init-from", str(tmp_path / "some" / "plain")))
    expected = "jaxskills train run --seed 0 --init-from runs/plain --out runs/like"
    assert record["command"] == expected


def test_where_a_record_was_made(tmp_path: Path):
    found = provenance.describe(tmp_path)
    assert found["versions"]["jax"] == jax.__version__
    assert found["cores"] >= 1 and found["processor"] and found["device"]
    assert found["backend"] in physics.BACKENDS
    assert found["commit"] == ""  # not a checkout
