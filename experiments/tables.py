# SPDX-License-Identifier: Apache-2.0
"""Prints the tables of the README from the JSON files of both `results/` folders.

    python experiments/tables.py [--write README.md]

With --write, the part of the file between the two `tables.py` comments is replaced.
"""

import argparse
import json
import re
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
BENCHMARKS = Path(__file__).parents[1] / "benchmarks" / "results"
BLOCK = re.compile(r"(<!-- tables\.py -->\n).*?(<!-- end of tables\.py -->)", re.DOTALL)
PAPER = {"walk": 4.08e6, "run": 4.11e6}  # samples, SB Table 1

_HEAD = (
    "| skill | seed | samples | paper's | minutes | 20 s without a fall | at 600 Hz physics |",
    "|---|---|---|---|---|---|---|",
)


def records(folder: Path) -> list[dict[str, Any]]:
    """Returns the records of `reproduce.py`, by skill and seed."""
    found = [json.loads(path.read_text()) for path in folder.glob("*.json")]
    return sorted(found, key=lambda record: (record["skill"], record["seed"]))


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
        *rates,
    ]
    return "| " + " | ".join(cells) + " |"


def table(found: list[dict[str, Any]]) -> str:
    """Returns the table of trainings, and what they ran on."""
    machines = sorted({f"{r['processor']}, {r['cores']} cores, `{r['backend']}`" for r in found})
    return "\n".join([*_HEAD, *map(row, found), "", f"Measured on: {'; '.join(machines)}."])


def speed(physics: dict[str, Any], train: dict[str, Any]) -> str:
    """Returns the table of speeds, from what both benchmarks printed."""
    shares = ", ".join(f"{name} {share:.0%}" for name, share in train["shares"].items())
    rows = {
        "training, control steps/s": f"{train['control_steps_per_s']:.0f} ({shares})",
        "`cpu` physics inside jit, steps/s": f"{physics['cpu_steps_per_s']:.0f}",
        "the same, as a share of a bare C loop": f"{physics['cpu_over_bare']:.2f}",
        "`mjx` on this CPU, as a share of a bare C loop": f"{physics['mjx_over_bare']:.3f}",
    }
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    return "\n".join(["| speed | |", "|---|---|", *lines])


def page() -> str:
    """Returns all tables."""
    benchmarks = [json.loads((BENCHMARKS / f"{n}.json").read_text()) for n in ("physics", "train")]
    return f"{table(records(RESULTS))}\n\n{speed(*benchmarks)}"


def main() -> None:
    """Prints or writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    text = page()
    if options.write is None:
        print(text)
        return
    before = options.write.read_text()
    if not BLOCK.search(before):
        parser.error(f"{options.write} has no line <!-- tables.py -->")
    options.write.write_text(BLOCK.sub(lambda found: f"{found[1]}{text}\n{found[2]}", before))


if __name__ == "__main__":
    main()
