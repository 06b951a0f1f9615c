# SPDX-License-Identifier: Apache-2.0
"""When a training is over."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tiny_family

from jaxskills import evaluate, families, judge, trainer
from jaxskills.judge import FamilyJudge, SkillJudge
from jaxskills.trainer import Trainer

_STATE: Any = SimpleNamespace(refinement=SimpleNamespace(fine=False))  # no more is looked at


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return families.make(tiny_family.config(tmp_path_factory.mktemp("walks")))


@pytest.fixture
def skill(family: Trainer) -> Trainer:
    config = family.config
    env = dataclasses.replace(config.env, reward="survival", time_warp=False)
    return trainer.make(dataclasses.replace(config, task="", env=env))


def _survived(seconds: float, gone: float = 0.0) -> dict[str, float]:
    return {"survival_s": seconds, "wall_s": gone}


def test_a_skill_that_stands_on_coarse_physics_alone_is_not_learnt(
    skill: Trainer, monkeypatch: pytest.MonkeyPatch
):
    rates = {skill.config.env.substeps: 1.0, evaluate.FINE_SUBSTEPS: 0.969}

    def found(self: Any, state: Any, substeps: int) -> tuple[dict[str, float], float]:
        return {"success_rate": rates[substeps]}, 0.0

    monkeypatch.setattr(SkillJudge, "_evaluate", found)
    judged, state = judge.make(skill), _STATE
    assert isinstance(judged, SkillJudge)
    assert judged(state, _survived(1.0)) == {}  # too early to be worth its time
    assert judged(state, _survived(5.0)) == {"success_rate": 1.0, "fine_success_rate": 0.969}
    assert not judged.learnt
    rates[evaluate.FINE_SUBSTEPS] = 0.984  # 63 of 64
    judged(state, _survived(5.0))
    assert judged.learnt


@pytest.mark.parametrize("lucky", [1, 2, 3])
def test_a_skill_that_passes_once_was_lucky(
    lucky: int, skill: Trainer, monkeypatch: pytest.MonkeyPatch
):
    """Both rates are asked twice; whoever passes `lucky` of these four and then fails goes on."""
    rates = iter([1.0] * lucky + [0.95] + [1.0] * 4)
    monkeypatch.setattr(SkillJudge, "_evaluate", lambda *_: ({"success_rate": next(rates)}, 0.0))
    judged = judge.make(skill)
    found = judged(_STATE, _survived(5.0))
    assert 0.95 in found.values() and not judged.learnt
    assert judged(_STATE, _survived(5.0)) == {"success_rate": 1.0, "fine_success_rate": 1.0}
    assert judged.learnt and next(rates, None) is None


def test_a_refined_skill_is_asked_at_its_own_rate(skill: Trainer, monkeypatch: pytest.MonkeyPatch):
    rates = []

    def found(self: Any, state: Any, substeps: int) -> tuple[dict[str, float], float]:
        rates.append(substeps)
        return {"success_rate": 1.0}, 0.0

    monkeypatch.setattr(SkillJudge, "_evaluate", found)
    refined: Any = SimpleNamespace(refinement=SimpleNamespace(fine=True))
    judge.make(skill)(refined, _survived(5.0))
    assert rates == [2 * skill.config.env.substeps, evaluate.FINE_SUBSTEPS] * 2


def test_evaluations_wait_unless_survival_has_doubled(
    skill: Trainer, monkeypatch: pytest.MonkeyPatch
):
    found = {"success_rate": 0.25}
    monkeypatch.setattr(SkillJudge, "_evaluate", lambda *_: (found, 60.0))  # a costly minute
    judged, state = judge.make(skill), _STATE
    times = (2.5, 2.5, 4.9, 5.0, 5.0, 9.9, 10.0)
    asked = [bool(judged(state, _survived(survival))) for survival in times]
    assert asked == [True, False, False, True, False, False, True]


@pytest.mark.parametrize(
    ("rate", "gone", "pause"),
    [(0.4, 900.0, 120.0), (0.7, 900.0, 90.0), (0.7, 90.0, 30.0), (0.9, 900.0, 30.0)],
)
def test_evaluations_are_few_until_few_fall(
    rate: float, gone: float, pause: float, skill: Trainer, monkeypatch: pytest.MonkeyPatch
):
    """Of 6 s each: a twentieth of the time, a tenth of that gone by apart, a fifth of the time."""
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(judge, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(SkillJudge, "_evaluate", lambda *_: ({"success_rate": rate}, 6.0))
    judged = judge.make(skill)
    assert judged(_STATE, _survived(5.0, gone))
    clock.now += pause - 0.1
    assert not judged(_STATE, _survived(5.0, gone))
    clock.now += 0.2
    assert judged(_STATE, _survived(5.0, gone))


def _performs(monkeypatch: pytest.MonkeyPatch, off: float, falls: int) -> list[np.ndarray]:
    """Has all families meet a height that is `off` too much, and fall `falls` times of 50."""
    asked = []

    def performances(state: Any, a: np.ndarray) -> SimpleNamespace:
        asked.append(a)
        through = np.arange(len(a)) >= falls
        return SimpleNamespace(through=through, met=a + np.array([off, 0.3]))

    monkeypatch.setattr(judge.perform, "make", lambda made, count: performances)
    return asked


@pytest.mark.parametrize(
    ("off", "falls", "learnt"), [(0.02, 2, True), (0.02, 3, False), (0.06, 0, False)]
)
def test_a_family_is_learnt_when_it_does_new_tasks_closely(
    family: Trainer, monkeypatch: pytest.MonkeyPatch, off: float, falls: int, learnt: bool
):
    """Heights are multiples, 0.5 to 1.5; gravity is a condition, which is met whatever happens."""
    asked = _performs(monkeypatch, off, falls)
    judged, state = judge.make(family), _STATE
    assert isinstance(judged, FamilyJudge)
    assert judged(state, {"explored": 0.98}) == {} and not asked
    found = judged(state, {"explored": 0.995})
    assert found["success_rate"] == pytest.approx(1 - falls / 50)
    expected = np.mean(off / (0.5 + asked[0][falls:, 0]))
    assert found["error_mean"] == pytest.approx(expected, rel=1e-4)
    assert judged.learnt is learnt


def test_a_family_is_asked_for_other_tasks_each_time(
    family: Trainer, monkeypatch: pytest.MonkeyPatch
):
    asked = _performs(monkeypatch, 0.0, 50)
    judged, state = judge.make(family), _STATE
    for _ in range(2):
        assert judged(state, {"explored": 1.0}) == {"success_rate": 0.0, "error_mean": 1.0}
    assert not judged.learnt
    assert not np.allclose(asked[0], asked[1])


def test_who_wants_all_samples_is_not_judged(family: Trainer, monkeypatch: pytest.MonkeyPatch):
    asked = _performs(monkeypatch, 0.0, 0)
    config = dataclasses.replace(family.config, stop_when_learnt=False)
    judged = judge.make(family._replace(config=config))
    assert judged(_STATE, {"explored": 1.0, "survival_s": 20.0}) == {}
    assert not asked and not judged.learnt
