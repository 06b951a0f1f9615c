# SPDX-License-Identifier: Apache-2.0
"""The live line: its text, and how often it prints into a log."""

import pytest

from jaxskills import progress


@pytest.mark.parametrize(
    ("samples", "pace", "text"),
    [
        (0, 0.0, "walk  0 of 20M samples (0%)  survival 3.1 s  0/s  ? left"),
        (1_234_000, 25_000.0, "walk  1.23M of 20M samples (6%)  survival 3.1 s  25k/s  12:31 left"),
        (2_000_000, 1000.0, "walk  2M of 20M samples (10%)  survival 3.1 s  1k/s  5:00:00 left"),
        (20_004_096, 999.6, "walk  20M of 20M samples (100%)  survival 3.1 s  1000/s  0:00 left"),
    ],
)
def test_line(samples: int, pace: float, text: str):
    metrics = {"samples": samples, "survival_s": 3.14, "other": 1}
    assert progress.line("walk", 20_000_000, metrics, pace) == text


def test_line_of_adaptive_bounds():
    metrics = {"samples": 0, "survival_s": 3.14, "bound_scale": 0.851}
    expected = "walk  0 of 20M samples (0%)  survival 3.1 s  bounds x0.85  0/s  ? left"
    assert progress.line("walk", 20_000_000, metrics, 0.0) == expected


FAMILY = {
    "samples": 967_680,
    "survival_s": 153.6,
    "episodes": 22_812,
    "base_learnt": True,
    "refining": False,
    "explored": 0.414,
    "success": 0.9968,
}


@pytest.mark.parametrize(
    ("changes", "phase"),
    [({}, "exploring"), ({"refining": True}, "refining"), ({"base_learnt": False}, "base")],
)
def test_line_of_a_family(changes: dict, phase: str):
    line = progress.line("pivot", 2_000_000, FAMILY | changes, 0.0)
    assert line == (
        f"pivot  968k of 2M samples (48%)  22.8k episodes  {phase}  explored 41%  success 100%"
        "  0/s  ? left"
    )


def _report_five(every: float) -> None:
    with progress.live("walk", 10, every=every) as report:
        for samples in range(1, 6):
            report({"samples": samples, "survival_s": 0.5})


def test_every_report_prints_when_due(capsys: pytest.CaptureFixture[str]):
    _report_five(every=0.0)
    out, err = capsys.readouterr()
    assert [row.split()[1] for row in err.splitlines()] == ["1", "2", "3", "4", "5"]
    assert out == ""


def test_first_and_last_print_in_a_short_run(capsys: pytest.CaptureFixture[str]):
    _report_five(every=60.0)
    assert [row.split()[1] for row in capsys.readouterr().err.splitlines()] == ["1", "5"]


def test_last_line_shows_after_an_interruption(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(KeyboardInterrupt), progress.live("walk", 10, every=60.0) as report:
        report({"samples": 1, "survival_s": 0.5})
        report({"samples": 2, "survival_s": 0.5})
        raise KeyboardInterrupt
    assert [row.split()[1] for row in capsys.readouterr().err.splitlines()] == ["1", "2"]


def test_pace_leaves_out_what_was_done_before(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with progress.live("walk", 100, done=50) as report:
        now = 102.0
        report({"samples": 70, "survival_s": 0.5})
    assert capsys.readouterr().err.rstrip().endswith("10/s  0:03 left")
