# SPDX-License-Identifier: Apache-2.0
"""FS Table 1: how much of its task space each family explores, in how many episodes.

    python experiments/fs_table1.py [--only pivot dodge] [--samples 2000000] [--runs runs]

Trains the family of every skill of the table, then lets it perform 50 new task parameters. A skill
without a recipe is skipped; one whose record is there already is left out; a run that was cut off
goes on. `experiments/tables.py` prints the table beside the paper's.
"""

import argparse
import math
import shutil
import sys
from pathlib import Path

from reproduce import RESULTS, jaxskills, keep, reproduce

from jaxskills import character, commands, recipes, trainer

# Control steps, at most. A family goes on as long as it may: there is always more to refine.
SAMPLES = {
    "pivot": 2_000_000,
    "dodge": 4_000_000,
    "obstacle_jump": 10_000_000,
    "spinkick": 20_000_000,
    "jump": 20_000_000,
    "cartwheel": 40_000_000,
    "backflip": 40_000_000,
    "box_jump": 40_000_000,
    "punch": 40_000_000,
    "push": 20_000_000,
    "sidekick": 40_000_000,
    "swing": 20_000_000,
    "wall_jump": 20_000_000,
}


def main() -> None:
    """Trains what is not there yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SAMPLES, default=list(SAMPLES))
    parser.add_argument("--seed", type=int, default=0)
    most = parser.add_mutually_exclusive_group()
    most.add_argument("--samples", type=int, help="of each training, at most")
    most.add_argument("--episodes", type=int, help="of each training, about, instead of samples")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where run folders go")
    options = parser.parse_args()
    for skill in options.only:
        name = f"{skill}_family"
        run = options.runs / f"{name}-{options.seed}"
        if name not in recipes.names():
            print(f"{name}: no such recipe yet, skipped", file=sys.stderr)
        elif (RESULTS / f"{run.name}.json").is_file():
            print(f"{run.name} is there", file=sys.stderr)
        else:
            samples = options.samples or SAMPLES[skill]
            if options.episodes:
                samples = options.episodes * steps(name)
            record = reproduce(name, options.seed, run, ("--samples", str(samples)))
            keep(record, run, RESULTS, name)
            show(run, name)


def show(run: Path, name: str) -> None:
    """Keeps the film of a family over its task space, and the plot of that (FS fig. 5)."""
    films = sorted(run.glob("*.mp4"))
    if films:
        shutil.copy(films[0], RESULTS / f"{name}.mp4")
    jaxskills("plot", str(run), "--out", str(RESULTS / f"{name}-space.png"))


def steps(name: str) -> int:
    """Returns how many control steps an episode of a family has that is not cut short."""
    config = commands.settings(recipes.find(name))
    motion = trainer.reference(config, character.load(config.character))
    return math.ceil(float(motion.length) + config.env.hold)


if __name__ == "__main__":
    main()
