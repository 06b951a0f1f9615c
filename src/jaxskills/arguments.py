# SPDX-License-Identifier: Apache-2.0
"""What can be typed after `jaxskills`: one dataclass for each command, its fields the options."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf

Skill = Annotated[str, conf.Positional, conf.arg(metavar="SKILL")]
Run = Annotated[Path, conf.Positional, conf.arg(metavar="RUN")]
File = Annotated[str, conf.Positional, conf.arg(metavar="CLIP")]
Flag = Annotated[bool, conf.FlagCreatePairsOff]
Backend = Literal["auto", "cpu", "mjx", "warp"]


@dataclasses.dataclass(frozen=True)
class Train:
    """Learn a controller from one motion clip.

    Writes config.json, metrics.jsonl, TensorBoard events, checkpoints and, at the end, a film and a
    film strip into the run folder. Ctrl-C saves and stops; --resume goes on from there.
    """

    skill: Skill
    """A recipe's name (such as walk), a clip file, or a recipe file."""
    out: Annotated[Path, conf.arg(metavar="RUN")]
    """Folder of the run. It must be new or empty, unless --resume is given."""
    resume: Flag = False
    """Go on with the run in that folder, with its settings except those given here."""
    bounds_file: Annotated[Path | None, conf.arg(name="bounds.file", metavar="TOML")] = None
    """File with the sizes of the bounds, see `jaxskills bounds`. Options --bounds... go first."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure how long a trained controller stays up, or how well a family does what it is asked.

    A family performs its motion once for each of some new task parameters.
    """

    run: Run
    """Folder of a run."""
    seconds: float | None = None
    """Length of an episode in s. None: 20; of a family one performance, always."""
    episodes: int | None = None
    """Number of episodes. None: 32; of a family 50, each of another task parameter."""
    substeps: int | None = None
    """Physics steps per control step of 1/30 s (20: 600 Hz). None: as in the training."""
    seed: int = 1
    """Seed of the phases at which episodes start, or of the task parameters."""
    style_clip: str | None = None
    """A clip, by name or file: also say how far from its style. None: the one the run wanted."""
    backend: Backend = "auto"
    """Physics engine; auto takes the best one for this machine, whatever the run learnt on."""
    json: Flag = False
    """Print one JSON object."""


@dataclasses.dataclass(frozen=True)
class Render:
    """Film a trained controller beside its reference motion."""

    run: Run
    """Folder of a run."""
    out: Path
    """File to write: .mp4 for a film, .png for a film strip."""
    seconds: float = 10.0
    """Length of the film in s; it ends shortly after a fall."""
    task: Annotated[tuple[str, ...], conf.arg(metavar="NAME=VALUE,...")] = ()
    """Of a family: what to perform, as in --task energy=1.2 gravity=0.5. Several values, as in
    rotation=0.8,1.6,2.4, of one or two parameters give a grid. Not named: as in the reference."""
    backend: Backend = "auto"
    """Physics engine; auto takes the best one for this machine, whatever the run learnt on."""


@dataclasses.dataclass(frozen=True)
class Plot:
    """Plot a training: learning curve, bound margins over phase, what ended the episodes.

    Of a family: the curriculum, what of the task space is explored, what new parameters give.
    """

    run: Run
    """Folder of a run."""
    out: Path
    """Picture to write: .png, .pdf or .svg."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Write a file with the default bounds of a character, to edit and to train with."""

    out: Path
    """File to write: .toml. It must not exist yet."""
    character: str = "humanoid34"
    """A shipped character's name or an MJCF file."""


@dataclasses.dataclass(frozen=True)
class ClipsList:
    """List the motion clips that are known by name."""

    json: Flag = False
    """Print one JSON object."""


@dataclasses.dataclass(frozen=True)
class ClipsCheck:
    """Say what is wrong with a motion clip, and whether the character can follow it."""

    file: File
    """A clip file (.txt, .json, .bvh, .npz) or the name of a known clip."""
    character: str = "humanoid34"
    """A shipped character's name or an MJCF file."""
    json: Flag = False
    """Print one JSON object."""


@dataclasses.dataclass(frozen=True)
class ClipsShow:
    """Film a motion clip on a character, as it is, without physics."""

    file: File
    """A clip file (.txt, .json, .bvh, .npz) or the name of a known clip."""
    out: Path
    """File to write: .mp4 for a film, .png for a film strip."""
    character: str = "humanoid34"
    """A shipped character's name or an MJCF file."""


@dataclasses.dataclass(frozen=True)
class Clips:
    """List, check and film motion clips."""

    action: Annotated[
        Annotated[ClipsList, conf.subcommand("list")]
        | Annotated[ClipsCheck, conf.subcommand("check")]
        | Annotated[ClipsShow, conf.subcommand("show")],
        conf.OmitSubcommandPrefixes,
        conf.OmitArgPrefixes,
    ]


Command = (
    Annotated[
        Train, conf.subcommand("train", description="Learn a controller from one motion clip.")
    ]
    | Annotated[Evaluate, conf.subcommand("evaluate")]
    | Annotated[Render, conf.subcommand("render")]
    | Annotated[Plot, conf.subcommand("plot")]
    | Annotated[Bounds, conf.subcommand("bounds")]
    | Annotated[Clips, conf.subcommand("clips")]
)
