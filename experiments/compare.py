# SPDX-License-Identifier: Apache-2.0
"""The paper's comparisons, each one command: the same skill trained in several ways.

    python experiments/compare.py backflip_starts [--runs runs]

Records and film strips are written to `experiments/results/NAME/`. A case whose record is there is
left out, that of the same training elsewhere is copied, also where `reproduce.py` made it of the
recipe on such a machine, and a run that was cut off goes on. `experiments/tables.py` makes the
tables of `experiments/README.md`, which says what each comparison is for and what it costs.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

from reproduce import RESULTS, jaxskills, keep, reproduce

from jaxskills import cli, clip, provenance, recipes
from jaxskills.errors import UserError
from jaxskills.judge import SURE_RATE


class Case(NamedTuple):
    """One training of a comparison."""

    skill: str
    options: tuple[str, ...] = ()  # of `jaxskills train`, besides the recipe's
    against: tuple[str, ...] = ()  # clips from whose style it is measured how far the skill is
    after: str = ""  # NAME/LABEL of the case whose networks it begins with


def _of(text: str) -> tuple[str, ...]:
    return tuple(text.split())


# Beside the paper's names, how DeepMimic differs: its reward, its end of an episode, its starts,
# and a policy without feed-forward.
_IMITATION = "--env.reward imitation --env.stop fall"
_DEEPMIMIC = f"{_IMITATION} --starts.uniform 1 --env.no-feedforward"
_TIGHT = "--bounds.com 0.15 0.15 0.1 --bounds.root 0.35 --bounds.joints 0.35"
_SB = "--bounds.com 0.3 0.3 0.2 --bounds.root 0.7 --bounds.joints 0.7"
_LOOSE = "--bounds.com 0.6 0.6 0.4 --bounds.root 1.4 --bounds.joints 1.4"

_ADAPTIVE = "--adaptive-bounds.enabled"


def _poor(skill: str, samples: int) -> dict[str, Case]:
    most = f"--samples {samples} "
    return {
        "bounds": Case(skill, _of(most)),
        "bounds_imitation": Case(skill, _of(most + "--env.reward imitation")),
        "imitation": Case(skill, _of(most + _IMITATION)),
        "deepmimic": Case(skill, _of(most + _DEEPMIMIC + " --evolution.no-enabled")),
    }


# The skill without a style is learnt first, and each style begins with its networks.
_STYLED = "--samples 1000000 --no-stop-when-learnt"


def _styles(name: str, skill: str, samples: int) -> dict[str, Case]:
    """The styles of SB 5.3.1; a recipe for styles has loose bounds, and is plain without one."""
    cases = {"plain": Case(skill, _of(f"--samples {samples}"))}
    for style in ("energy_up", "energy_down", "volume_up", "volume_down"):
        how = f"{_STYLED} --env.reward style --env.style.style {style}"
        cases[style] = Case(skill, _of(how), after=f"{name}/plain")
    return cases


def _transfers(
    name: str, skill: str, loose: str, clips: tuple[str, ...], samples: int
) -> dict[str, Case]:
    """The style transfer of SB 5.3.2: the skill, and in `loose` bounds with each clip's style."""
    gram = f"{_STYLED} --env.reward style --env.style.style gram --env.style.style-clip"
    cases = {"plain": Case(skill, _of(f"--samples {samples}"), clips)}
    styled = {one: Case(loose, _of(f"{gram} {one}"), clips, f"{name}/plain") for one in clips}
    return cases | styled


def _blends(skill: str, style: str, after: str) -> dict[str, Case]:
    """SB Table 2: no bounds, imitation and style weighted."""
    how = f"{_STYLED} --env.reward blend --env.stop fall --env.style.style {style}"
    return {
        f"weight_{weight}": Case(skill, _of(f"{how} --env.style-weight {weight}"), after=after)
        for weight in (0.5, 0.6, 0.7, 0.8)
    }


def _ablation(skill: str, samples: int) -> dict[str, Case]:
    """FS Table 2: without parameterisation and time warp, without time warp, and with both.

    The curriculum is the simple one that the paper takes here.
    """
    how = f"--samples {samples} --family.curriculum.method fixed_alternation"
    return {
        "A1": Case(skill, _of(f"{how} --env.no-time-warp --family.no-vary")),
        "A2": Case(skill, _of(f"{how} --env.no-time-warp")),
        "A3": Case(skill, _of(how)),
    }


def _curricula(skill: str, samples: int) -> dict[str, Case]:
    """FS fig. 8."""
    how = f"--samples {samples}"
    methods = {
        "uniform": "uniform",
        "explore_only": "explore_only",
        "mastering": "mastering",
        "alternating": "fixed_alternation",
    }
    cases = {
        name: Case(skill, _of(f"{how} --family.curriculum.method {method}"))
        for name, method in methods.items()
    }
    return {"ours": Case(skill, _of(how))} | cases


def _stops(skill: str, samples: int) -> dict[str, Case]:
    """A family whose episodes end at the bounds of SB, at those of the authors of FS, and ours."""
    how = f"--samples {samples}"
    return {
        "sb": Case(skill, _of(f"{how} --env.stop bounds {_SB} --bounds.end-effectors 0.5")),
        "authors": Case(skill, _of(f"{how} --bounds.root 1.26")),
        "default": Case(skill, _of(how)),
    }


def _switched(skill: str, samples: int, without: str, label: str, option: str) -> dict[str, Case]:
    """A skill or a family as it is, and with one option."""
    how = f"--samples {samples}"
    return {without: Case(skill, _of(how)), label: Case(skill, _of(f"{how} {option}"))}


COMPARISONS: dict[str, dict[str, Case]] = {
    "backflip_starts": {
        "importance": Case("backflip", _of("--samples 6000000")),
        "uniform": Case("backflip", _of("--samples 6000000 --starts.uniform 1")),
    },
    "break_dance_evolution": {
        "on": Case("break_dance", _of("--samples 4000000")),
        "off": Case("break_dance", _of("--samples 4000000 --evolution.no-enabled")),
    },
    "feedforward": {
        "with": Case("walk", _of("--samples 2000000")),
        "without": Case("walk", _of("--samples 2000000 --env.no-feedforward")),
    },
    "walk_bounds": {
        "tight": Case("walk", _of(f"--samples 2000000 {_TIGHT} --bounds.end-effectors 0.25")),
        "default": Case("walk", _of("--samples 2000000")),
        "loose": Case("walk", _of(f"--samples 2000000 {_LOOSE} --bounds.end-effectors 1")),
    },
    "cartwheel_bounds": {
        "tight": Case("cartwheel", _of(f"--samples 4000000 {_TIGHT} --bounds.end-effectors 0.25")),
        "default": Case("cartwheel", _of("--samples 4000000")),
        "loose": Case("cartwheel", _of(f"--samples 4000000 {_LOOSE} --bounds.end-effectors 1")),
    },
    "run_adaptive": _switched("run", 4_000_000, "fixed", "adaptive", _ADAPTIVE),
    "cartwheel_adaptive": _switched("cartwheel", 4_000_000, "fixed", "adaptive", _ADAPTIVE),
    "sparse_jog": _poor("sparse_jog", 2_000_000),
    "sparse_high_knees": _poor("sparse_high_knees", 2_000_000),
    "cartwheel_styles": _styles("cartwheel_styles", "cartwheel_style", 4_000_000),
    "dance_styles": _styles("dance_styles", "dance_style", 5_000_000),
    "run_styles": _transfers(
        "run_styles", "run", "run_style", ("happy_walk", "bent_walk"), 4_000_000
    ),
    "cartwheel_blend": _blends("cartwheel_style", "energy_down", "cartwheel_styles/plain"),
    # Families of skills
    "spinkick_ablation": _ablation("spinkick_family", 2_000_000),
    "jump_ablation": _ablation("jump_gravity_family", 4_000_000),
    "dodge_curricula": _curricula("dodge_family", 1_000_000),
    "jump_curricula": _curricula("jump_gravity_family", 4_000_000),
    "dodge_stop": _stops("dodge_family", 1_000_000),
    "spinkick_stop": _stops("spinkick_family", 2_000_000),
    "push_torque": _switched(
        "push_family", 4_000_000, "limited", "unlimited", "--env.no-torque-limits"
    ),
}


def main() -> None:
    """Trains the cases that are not there yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="+", choices=COMPARISONS)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where run folders go")
    options = parser.parse_args()
    for name in options.names:
        find_clips(name)
    for name in options.names:
        for label, case in COMPARISONS[name].items():
            if (RESULTS / name / f"{label}.json").is_file():
                print(f"{name}/{label} is there", file=sys.stderr)
                continue
            if earlier := same(case) or plain(case):
                (RESULTS / name).mkdir(parents=True, exist_ok=True)
                for path in earlier:
                    shutil.copy(path, RESULTS / name / f"{label}{path.suffix}")
                print(f"{name}/{label} is the same training as {earlier[0]}", file=sys.stderr)
                continue
            run, begin = options.runs / name / label, ()
            if case.after:
                begin = "--init-from", str(options.runs / case.after)
            record = reproduce(case.skill, 0, run, (*case.options, *begin))
            record["gram_distances"] = {clip: gram_distance(run, clip) for clip in case.against}
            keep(record, run, RESULTS / name, label)


def find_clips(name: str) -> None:
    """Looks for all clips of a comparison, so that none is missed after hours of training.

    Raises:
      SystemExit: one is not there. What is missing was printed.
    """
    try:
        for case in COMPARISONS[name].values():
            for one in (recipes.find(case.skill).clip, *case.against):
                clip.find(one)
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(cli.BAD_INPUT) from None


def same(case: Case) -> list[Path]:
    """Returns the files of a record that is there of the same training, none if there is none."""
    for name, cases in COMPARISONS.items():
        for label, other in cases.items():
            if other == case and (RESULTS / name / f"{label}.json").is_file():
                return sorted(RESULTS.glob(f"{name}/{label}.*"))
    return []


def plain(case: Case) -> list[Path]:
    """Returns the files of the record that `reproduce.py` made of the same training, if any.

    That is one of the recipe as it is, learnt within the case's samples, on such a machine.
    """
    path = RESULTS / f"{case.skill}-0.json"
    if case != Case(case.skill, ("--samples", *case.options[1:2])) or not path.is_file():
        return []
    record, here = json.loads(path.read_text()), provenance.describe(RESULTS.parent)
    alike = all(record[name] == here[name] for name in ("processor", "backend", "versions"))
    learnt = record["curve"][-1].get("fine_success_rate", 0.0) >= SURE_RATE
    if not (alike and learnt and record["samples"] <= int(case.options[1])):
        return []
    return [path, *RESULTS.glob(f"{case.skill}.png")]


def gram_distance(run: Path, clip: str) -> float | None:
    """Returns how far the controller of a run is from the style of a clip; None if it fell."""
    answer = jaxskills("evaluate", str(run), "--episodes", "64", "--style-clip", clip, "--json")
    return json.loads(answer).get("gram_distance_mean") if answer else None


if __name__ == "__main__":
    main()
