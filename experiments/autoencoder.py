# SPDX-License-Identifier: Apache-2.0
"""Trains the motion autoencoder of the style `gram` on all clips that are known by name.

    python experiments/autoencoder.py

writes `data/autoencoder.npz`, for `humanoid34`, and what came out to
`experiments/results/autoencoder.json`: how well clips are reconstructed that a first training
leaves out, and how far apart the styles of clips are by the second one, which leaves out none. For
another character, or with clips of your own:

    python experiments/autoencoder.py --character robot.xml --clips mine.bvh --out robot.npz
"""

import argparse
import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills import character as character_lib
from jaxskills import clip, motion, physics, provenance, retarget
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import gram
from jaxskills.learn import autoencoder, windows
from jaxskills.learn.autoencoder import Autoencoder, AutoencoderConfig
from jaxskills.motion import Motion

RESULTS = Path(__file__).parent / "results"
HELD_OUT = ("run", "dance_b", "spinkick")
SHOWN = ("walk", "walker/0walk_forward", "run", "sparse_jog", "crawl", "dance_a", "spinkick")
_LOSSES = 20  # points kept of the loss
_TRIED = 32  # windows of a clip that errors are measured in


def motions(character: Character, names: Sequence[str]) -> dict[str, Motion]:
    """Returns the clips of these names or files as motions of the character."""
    found = {}
    for name in names:
        one = clip.load(name)
        qpos = retarget.retarget(character, one)
        found[Path(name).stem if Path(name).is_file() else name] = motion.from_qpos(
            character.model, qpos, one.times, one.loop
        )
    return found


def fit(
    character: Character, data: Sequence[np.ndarray], config: AutoencoderConfig, seed: int
) -> tuple[Autoencoder, list[float]]:
    """Returns an autoencoder trained on windows, and its loss along the way."""
    init_key, train_key = jax.random.split(jax.random.key(seed))
    rows = jnp.asarray(np.concatenate(data))
    model = autoencoder.init(config, character.body_names, rows, init_key)
    model, losses = autoencoder.train(config, model, rows, train_key)
    parts = np.array_split(np.asarray(losses), min(_LOSSES, len(losses)))
    return model, [round(float(part.mean()), 5) for part in parts]


def errors(model: Autoencoder, data: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Returns by clip the error of positions in cm and the share of the variance that is lost."""
    measure, found = jit(autoencoder.error), {}
    for name, rows in data.items():
        chosen = rows[np.linspace(0, len(rows) - 1, _TRIED).astype(int)]
        wrong = np.asarray(measure(model, chosen))
        lost = np.mean((wrong / model.scale) ** 2)
        deviation = np.mean(chosen.std((0, 1)) ** 2 / np.asarray(model.scale) ** 2)
        positions = np.sqrt(np.mean(wrong[:-4] ** 2))
        found[name] = {
            "positions_cm": round(100 * float(positions), 2),
            "variance_lost": round(float(lost / deviation), 4),
        }
    return found


def gram_distances(
    model: Autoencoder, character: Character, shown: dict[str, Motion]
) -> dict[str, dict[str, float]]:
    """Returns how far apart the styles of any two motions are."""
    styles, width = {}, model.width
    look = jit(lambda *x: gram.frames_of(character, *x))
    for name, one in shown.items():
        table = gram.table(
            one, look(one.qpos, one.qvel), lambda x: autoencoder.style(model, x), width
        )
        styles[name] = gram.style_of(table, width)
    return {
        a: {b: round(float(gram.distance(styles[a], styles[b])), 3) for b in styles} for a in styles
    }


def report(record: dict[str, Any]) -> str:
    """Returns the tables of a record."""
    lines = []
    for title in ("held_out", "errors"):
        lines.append(f"{title}: position error in cm, share of the variance lost")
        lines += [
            f"  {name:24} {row['positions_cm']:6.2f} {row['variance_lost']:8.4f}"
            for name, row in record[title].items()
        ]
    names = list(record["gram_distance"])
    lines.append("gram distance between styles: " + ", ".join(names))
    for name in names:
        row = " ".join(f"{value:6.3f}" for value in record["gram_distance"][name].values())
        lines.append(f"  {name:24} {row}")
    return "\n".join(lines)


def main() -> None:
    """Trains twice, writes the network and the record."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--character", default="humanoid34")
    parser.add_argument("--clips", nargs="*", default=[], help="files to learn from besides")
    parser.add_argument("--held-out", nargs="*", default=HELD_OUT, help="clips to be tried on")
    parser.add_argument("--compare", nargs="*", default=[], help="files to be tried on, unseen")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=AutoencoderConfig.steps)
    parser.add_argument("--out", type=Path, default=autoencoder.shipped())
    parser.add_argument("--record", type=Path, default=RESULTS / "autoencoder.json")
    options = parser.parse_args()
    physics.configure_cpu()
    config = AutoencoderConfig(steps=options.steps)
    who = character_lib.load(options.character)
    known = motions(who, [*clip.available(), *options.clips])
    others = motions(who, options.compare)
    cut = windows.cut(who, [*known.values(), *others.values()], config.window, config.speeds)
    data = dict(zip((*known, *others), cut, strict=True))
    record: dict[str, Any] = {
        "command": shlex.join(["python", "experiments/autoencoder.py", *sys.argv[1:]]),
        "seed": options.seed,
        "steps": options.steps,
        "clips": list(known),
        "windows": sum(len(data[name]) for name in known),
        **provenance.describe(RESULTS.parent),
    }
    begin = time.monotonic()
    if options.held_out:
        print("training without the clips held out", file=sys.stderr)
        rest = [data[name] for name in known if name not in options.held_out]
        model, _ = fit(who, rest, config, options.seed)
        record["held_out"] = errors(model, {name: data[name] for name in options.held_out})
    print("training", file=sys.stderr)
    model, record["loss"] = fit(who, [data[name] for name in known], config, options.seed)
    record["wall_s"] = round(time.monotonic() - begin, 1)
    record["errors"] = errors(model, data)
    shown = {name: known[name] for name in SHOWN if name in known} | others
    record["gram_distance"] = gram_distances(model, who, shown)
    print(report({"held_out": {}} | record))
    print(f"wrote {autoencoder.save(model, options.out)}", file=sys.stderr)
    options.record.parent.mkdir(parents=True, exist_ok=True)
    options.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
