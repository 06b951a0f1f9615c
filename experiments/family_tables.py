# SPDX-License-Identifier: Apache-2.0
"""Tables of families of skills, from the records that `reproduce.py` writes; see `tables.py`."""

from typing import Any, NamedTuple


class Paper(NamedTuple):
    """A row of FS Table 1."""

    skill: str
    episodes: float  # N
    explored: float  # ER


PAPER = {  # by recipe
    "backflip_family": Paper("Backflip", 2.1e6, 0.90),
    "box_jump_family": Paper("BoxJump", 2.2e6, 0.91),
    "cartwheel_family": Paper("Cartwheel", 3.5e6, 1.0),
    "dodge_family": Paper("Dodge", 0.2e6, 1.0),
    "jump_family": Paper("Jump", 1.65e6, 0.92),
    "obstacle_jump_family": Paper("ObstacleJump", 0.5e6, 1.0),
    "pivot_family": Paper("Pivot", 0.12e6, 1.0),
    "punch_family": Paper("Punch", 4.2e6, 0.72),
    "push_family": Paper("Push", 0.7e6, 1.0),
    "sidekick_family": Paper("SideKick", 1.52e6, 0.81),
    "spinkick_family": Paper("SpinKick", 0.93e6, 1.0),
    "swing_family": Paper("Swing", 1.5e6, 1.0),
    "wall_jump_family": Paper("WallJump", 1e6, 1.0),
}

_HEAD = (
    "| family | seed | episodes | paper's | explored | paper's | new tasks without a fall"
    " | at 600 Hz physics | mean error | minutes |",
    "|---|---|---|---|---|---|---|---|---|---|",
)
_MOST = 0.9  # of the task space


def is_family(record: dict[str, Any]) -> bool:
    """Returns whether a record is of a family of skills."""
    return any("explored" in row for row in record.get("curve", ()))


def table(records: list[dict[str, Any]]) -> str:
    """Returns the table of families beside FS Table 1."""
    return "\n".join([*_HEAD, *map(row, records)])


def row(record: dict[str, Any]) -> str:
    """Returns one line of it."""
    paper, last, found = PAPER.get(record["skill"]), record["curve"][-1], record["evaluate"]
    cells = [
        record["skill"].removesuffix("_family"),
        str(record["seed"]),
        _millions(last["episodes"]),
        _millions(paper.episodes) if paper else "",
        f"{last['explored']:.2f}",
        f"{paper.explored:.2f}" if paper else "",
        *(_success(record[name]) for name in ("evaluate", "evaluate_600hz")),
        _errors(found),
        f"{record['wall_s'] / 60:.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def comparison(cases: dict[str, dict[str, Any]]) -> str:
    """Returns the table of a comparison of families: one line for each label's record."""
    names = {name for case in cases.values() for name in (case["evaluate"] or {}).get("errors", ())}
    for case in cases.values():
        names |= set((case["evaluate"] or {}).get("explored_ranges", ()))
    ordered = sorted(names)
    heads = ["case", "episodes", "explored", "90 % explored after", "without a fall", "mean error"]
    heads += [f"explored {name}" for name in ordered] + ["minutes"]
    lines = [heads, ["---"] * len(heads)]
    for label, record in cases.items():
        last, found = record["curve"][-1], record["evaluate"]
        ranges = (found or {}).get("explored_ranges", {})
        lines.append(
            [
                label,
                _millions(last["episodes"]),
                f"{last['explored']:.2f}",
                _first(record["curve"]),
                _success(found),
                _errors(found),
                *(_range(ranges.get(name)) for name in ordered),
                f"{record['wall_s'] / 60:.0f}",
            ]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _first(curve: list[dict[str, Any]]) -> str:
    """Returns after how many episodes most of the task space was explored, as far as is kept."""
    rows = [row for row in curve if row.get("explored", 0.0) >= _MOST]
    return _millions(rows[0]["episodes"]) if rows else "never"


def _success(found: dict[str, Any] | None) -> str:
    return f"{found['success_rate']:.0%} of {found['episodes']}" if found else "failed"


def _errors(found: dict[str, Any] | None) -> str:
    shown = ((found or {}).get("errors") or {}).items()
    return ", ".join(f"{name} {error['share']:.1%}" for name, error in shown)


def _range(ends: list[float] | None) -> str:
    return f"{ends[0]:.2f} to {ends[1]:.2f}" if ends else "nothing"


def _millions(count: float) -> str:
    return f"{count / 1e6:.3f} M"
