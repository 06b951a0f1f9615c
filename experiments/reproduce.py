# SPDX-License-Identifier: Apache-2.0
"""Trains skills as a person would, evaluates them, and keeps what came out, failed or not.

    python experiments/reproduce.py walk run --seeds 0 1 2 --runs runs

For each skill and seed: `jaxskills train` with the default settings, then `jaxskills evaluate` over
64 episodes, or of a family over 50 new task parameters, at the physics rate of the training and at
600 Hz. One JSON file each is written to `experiments/results/`, and the film strip of the first
seed. A run folder that exists is resumed, so a reproduction that was cut off can be started again.
`experiments/tables.py` prints the tables.
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from jaxskills import provenance
from jaxskills.cli import INTERRUPTED
from jaxskills.evaluate import FINE_SUBSTEPS

RESULTS = Path(__file__).parent / "results"
_CURVE = 40  # points kept of a learning curve
_COLUMNS = ("samples", "wall_s", "survival_s", "success_rate", "fine_success_rate")
# Of a family, besides.
_FAMILY_COLUMNS = (
    *(
        "episodes",
        "explored",
        "elites",
        "fitness",
        "task_error",
        "error_mean",
        "success",
        "base_learnt",
        "refining",
    ),
    *("marginal", "rate_around", "rate_inside"),
)


def reproduce(skill: str, seed: int, run: Path, options: tuple[str, ...] = ()) -> dict[str, Any]:
    """Returns the record of one run, JSON-ready.

    Args:
      skill: as for `jaxskills train`.
      seed: of the training.
      run: folder; resumed if it has a configuration.
      options: of `jaxskills train`, besides.

    Raises:
      SystemExit: the training was interrupted or never began, so there is nothing to record.
    """
    resumed = (run / "config.json").is_file()
    options = ("train", skill, "--seed", str(seed), *options, "--out", str(run))
    print(shlex.join(options), file=sys.stderr)
    code, seconds, first = train([*options, *["--resume"] * resumed])
    if code == INTERRUPTED or not (run / "metrics.jsonl").is_file():
        raise SystemExit(code)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    last = rows[-1]
    folders = [i + 1 for i, word in enumerate(options) if word in ("--out", "--init-from")]
    shown = [f"runs/{Path(x).name}" if i in folders else x for i, x in enumerate(options)]
    record = {
        "command": shlex.join(["jaxskills", *shown]),
        "skill": skill,
        "seed": seed,
        "exit_code": code,
        "resumed": resumed,
        "samples": last["samples"],
        "wall_s": last["wall_s"],
        "first_line_s": first,
        "command_s": seconds,
        **provenance.describe(RESULTS.parent),
    }
    episodes = [] if "explored" in last else ["--episodes", "64"]
    for name, rate in (("evaluate", []), ("evaluate_600hz", ["--substeps", str(FINE_SUBSTEPS)])):
        answer = jaxskills("evaluate", str(run), *episodes, "--json", *rate)
        record[name] = json.loads(answer) if answer else None
    columns = (*_COLUMNS, *_FAMILY_COLUMNS)
    record["curve"] = [{k: row[k] for k in columns if k in row} for row in thinned(rows)]
    return record


def train(options: list[str]) -> tuple[int, float, float | None]:
    """Returns exit code, wall seconds, and seconds until the first line of progress was shown."""
    begin, first = time.monotonic(), None
    command = [sys.executable, "-m", "jaxskills", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        for line in process.stderr:
            if first is None and " samples (" in line:
                first = round(time.monotonic() - begin, 1)
            print(line, end="", file=sys.stderr, flush=True)
    return process.returncode, round(time.monotonic() - begin, 1), first


def jaxskills(*options: str) -> str:
    """Returns the standard output of a command, nothing if it failed."""
    command = [sys.executable, "-m", "jaxskills", *options]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False).stdout


def thinned(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns evenly spaced rows, all rows with an evaluation, and the last."""
    stride = max(1, len(rows) // _CURVE)
    return [
        row
        for i, row in enumerate(rows)
        if i % stride == 0 or "success_rate" in row or i == len(rows) - 1
    ]


def keep(record: dict[str, Any], run: Path, folder: Path, strip: str = "") -> None:
    """Writes a record, and the film strip of its run if it is given a name, into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{run.name}.json"
    path.write_text(json.dumps(record, indent=1) + "\n")
    made = sorted(run.glob("*.png"))
    if strip and made:
        shutil.copy(made[0], folder / f"{strip}.png")
    print(f"wrote {path}", file=sys.stderr)


def main() -> None:
    """Runs all skills and seeds in turn."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("skills", nargs="+", help="recipes, see `jaxskills train --help`")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where run folders go")
    parser.add_argument("--samples", type=int, help="of each training at most")
    options = parser.parse_args()
    most = () if options.samples is None else ("--samples", str(options.samples))
    for skill in options.skills:
        for seed in options.seeds:
            name = Path(skill).stem
            run = options.runs / f"{name}-{seed}"
            strip = name if seed == options.seeds[0] else ""
            keep(reproduce(skill, seed, run, most), run, RESULTS, strip)


if __name__ == "__main__":
    main()
