# SPDX-License-Identifier: Apache-2.0
"""SB Table 1: how many samples until a skill stands 20 s without a fall, ours and the paper's.

    python experiments/table1.py [--only dance roll] [--samples 5000000] [--runs runs]

Trains every skill of the table with its recipe, survival reward only, the first two with three
seeds. A skill whose record is there already is left out; a run that was cut off goes on. `run_jump`
needs `JAXSKILLS_CLIP_DIR`, a folder with `humanoid3d_run_jump.txt`.
"""

import argparse
import sys
from pathlib import Path

from reproduce import RESULTS, keep, reproduce

# Skill: seeds, most samples. The paper's counts are in `tables.PAPER`.
SKILLS = {
    "walk": ((0, 1, 2), 4_080_000),
    "run": ((0, 1, 2), 4_110_000),
    "dance": ((0,), 10_000_000),
    "run_jump": ((0,), 11_020_000),
    "roll": ((0,), 12_310_000),
    "cartwheel": ((0,), 17_350_000),
    "backflip": ((0,), 41_200_000),
    "jump": ((0,), 41_630_000),
}


def main() -> None:
    """Trains what is not there yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=SKILLS, default=list(SKILLS))
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where run folders go")
    parser.add_argument("--samples", type=int, help="of each training at most; else the paper's")
    options = parser.parse_args()
    for skill in options.only:
        seeds, samples = SKILLS[skill]
        samples = min(samples, options.samples or samples)
        for seed in seeds:
            run = options.runs / f"{skill}-{seed}"
            if (RESULTS / f"{run.name}.json").is_file():
                print(f"{run.name} is there", file=sys.stderr)
                continue
            record = reproduce(skill, seed, run, ("--samples", str(samples)))
            keep(record, run, RESULTS, skill if seed == seeds[0] else "")


if __name__ == "__main__":
    main()
