# SPDX-License-Identifier: Apache-2.0
"""Prints the tables of both READMEs from the JSON files of both `results/` folders.

    python experiments/tables.py [--write README.md experiments/README.md]

With --write, the parts of the files between two `tables.py` comments are replaced: `<!-- tables.py
trainings -->`, or the name of another page below.
"""

import argparse
import json
import math
import re
from pathlib import Path
from typing import Any

import family_tables
from compare import COMPARISONS

RESULTS = Path(__file__).parent / "results"
BENCHMARKS = Path(__file__).parents[1] / "benchmarks" / "results"
BLOCK = re.compile(r"(<!-- tables\.py (\w+) -->\n).*?(<!-- end of tables\.py -->)", re.DOTALL)
PAPER = {  # samples, SB Table 1
    "walk": 4.08e6,
    "run": 4.11e6,
    "jump": 41.63e6,
    "roll": 12.31e6,
    "cartwheel": 17.35e6,
    "dance": 10.00e6,
    "run_jump": 11.02e6,
    "backflip": 41.20e6,
}
PASSED = 0.95  # of evaluated episodes, to count as learnt

_HEAD = (
    "| skill | seed | samples | paper's | minutes | cores | 20 s without a fall"
    " | at 600 Hz physics |",
    "|---|---|---|---|---|---|---|---|",
)


def records(folder: Path) -> list[dict[str, Any]]:
    """Returns the records of `reproduce.py`, by skill and seed."""
    found = [json.loads(path.read_text()) for path in folder.glob("*-*.json")]
    return sorted(found, key=lambda record: (record["skill"], record["seed"]))


def cases(folder: Path, name: str) -> dict[str, dict[str, Any]]:
    """Returns the records of a comparison that are there, by label."""
    paths = {label: folder / name / f"{label}.json" for label in COMPARISONS[name]}
    return {k: json.loads(path.read_text()) for k, path in paths.items() if path.is_file()}


def row(record: dict[str, Any]) -> str:
    """Returns one line of the table of trainings."""
    paper = PAPER.get(record["skill"])
    rates = [
        f"{record[name]['success_rate']:.1%} of {record[name]['episodes']}"
        if record[name]
        else "failed"
        for name in ("evaluate", "evaluate_600hz")
    ]
    cells = [
        record["skill"],
        str(record["seed"]),
        f"{record['samples'] / 1e6:.2f} M",
        f"{paper / 1e6:.2f} M" if paper else "",
        f"{record['wall_s'] / 60:.1f}",
        str(record["cores"]),
        *rates,
    ]
    return "| " + " | ".join(cells) + " |"


def table(found: list[dict[str, Any]]) -> str:
    """Returns the table of trainings, and what they ran on."""
    machines = sorted({f"{r['processor']}, `{r['backend']}`" for r in found})
    return "\n".join([*_HEAD, *map(row, found), "", f"Measured on: {'; '.join(machines)}."])


def speed(physics: dict[str, Any], train: dict[str, Any], family: dict[str, Any]) -> str:
    """Returns the table of speeds, from what the benchmarks printed."""
    shares = ", ".join(f"{name} {share:.0%}" for name, share in train["shares"].items())
    rows = {
        "training, control steps/s": f"{train['control_steps_per_s']:.0f} ({shares})",
        "`cpu` physics inside jit, steps/s": f"{physics['cpu_steps_per_s']:.0f}",
        "the same, as a share of a bare C loop": f"{physics['cpu_over_bare']:.2f}",
        "`mjx` on this CPU, as a share of a bare C loop": f"{physics['mjx_over_bare']:.3f}",
        f"family of skills with {family['elites']} elites: elites, parameterisation and curriculum,"
        " as a share of an update": f"{family['overhead']:.1%}",
    }
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    return "\n".join(["| speed | |", "|---|---|", *lines])


def comparison(by_label: dict[str, dict[str, Any]]) -> str:
    """Returns the table of a comparison: one line for each label's record."""
    heads = ["case", "samples", "95 % first after", "minutes", "20 s without a fall", "mean time"]
    cells = [[label, *_measured(record)] for label, record in by_label.items()]
    columns = [_found(record) for record in by_label.values()]
    for head in {head: None for found in columns for head in found}:
        heads.append(head)
        for row, found in zip(cells, columns, strict=True):
            row.append(found.get(head, ""))
    lines = [heads, ["---"] * len(heads), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


_OFF = (
    ("joint_error_mean", "joints off", math.degrees(1.0), "°"),
    ("com_error_mean", "CoM off", 100.0, " cm"),
)
_MEASURES = (("energy_mean", "energy, J", 1.0), ("volume_mean", "hull volume, l", 1e3))


def _found(record: dict[str, Any]) -> dict[str, str]:
    """Returns how closely the reference is followed, and of a comparison of styles their measures.

    By the heads of their columns, as far as they are known.
    """
    found, distances = record["evaluate"] or {}, record.get("gram_distances") or {}
    cells = {}
    for name, head, scale, unit in _OFF:
        if found.get(name) is not None:
            cells[head] = f"{scale * found[name]:.1f}{unit}"
    cells |= {f"distance from {clip}": f"{d:.2f}" for clip, d in distances.items() if d is not None}
    if "--env.style.style" in record["command"] or "_style " in record["command"]:
        for name, head, scale in _MEASURES:
            if found.get(name) is not None:
                cells[head] = f"{scale * found[name]:.1f}"
    return cells


def _measured(record: dict[str, Any]) -> list[str]:
    asked = [row for row in record["curve"] if "success_rate" in row]
    passed = [row for row in asked if row["success_rate"] >= PASSED]
    found = record["evaluate"]
    return [
        f"{record['samples'] / 1e6:.2f} M",
        f"{passed[0]['samples'] / 1e6:.2f} M" if passed else "never" if asked else "",
        f"{record['wall_s'] / 60:.0f}",
        f"{found['success_rate']:.0%} of {found['episodes']}" if found else "failed",
        f"{found['seconds_mean']:.1f} s" if found else "",
    ]


def trainings() -> str:
    """Returns the tables of trainings and of speed."""
    names = "physics", "train", "family"
    benchmarks = [json.loads((BENCHMARKS / f"{name}.json").read_text()) for name in names]
    found = [record for record in records(RESULTS) if not family_tables.is_family(record)]
    return f"{table(found)}\n\n{speed(*benchmarks)}"


def families() -> str:
    """Returns the table of families of skills."""
    found = [record for record in records(RESULTS) if family_tables.is_family(record)]
    return family_tables.table(found) if found else "None yet."


def comparisons() -> str:
    """Returns a table for each comparison of which there are results."""
    tables = []
    for name in COMPARISONS:
        found = {_linked(name, k): record for k, record in cases(RESULTS, name).items()}
        if found:
            of_families = all(map(family_tables.is_family, found.values()))
            made = family_tables.comparison(found) if of_families else comparison(found)
            drawn = RESULTS / name / "curves.png"
            shown = f"\n\n![{name}]({drawn.relative_to(RESULTS.parent)})" if drawn.is_file() else ""
            tables.append(f"**{name}**\n\n{made}{shown}")
    return "\n\n".join(tables) or "None yet."


def _linked(name: str, label: str) -> str:
    """Returns a case's label, with a link to its film strip if it has one."""
    strip = RESULTS / name / f"{label}.png"
    return f"[{label}]({strip.relative_to(RESULTS.parent)})" if strip.is_file() else label


PAGES = {"trainings": trainings, "families": families, "comparisons": comparisons}


def main() -> None:
    """Prints or writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    if not options.write:
        print("\n\n".join(make() for make in PAGES.values()))
    for path in options.write:
        before = path.read_text()
        if not BLOCK.search(before):
            parser.error(f"{path} has no line <!-- tables.py PAGE -->")
        path.write_text(BLOCK.sub(_filled, before))


def _filled(block: re.Match[str]) -> str:
    return f"{block[1]}{PAGES[block[2]]()}\n{block[3]}"


if __name__ == "__main__":
    main()
