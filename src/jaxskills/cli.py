# SPDX-License-Identifier: Apache-2.0
"""The command line: parses, calls `commands`, turns bad input into one line and exit code 2.

JAX and SciPy are imported only when a command needs them, so help and mistakes answer at once.
"""

import contextlib
import dataclasses
import errno
import importlib
import inspect
import io
import json
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import tyro
from tyro import conf

from jaxskills import arguments
from jaxskills.errors import UserError

PROGRAM = "jaxskills"

BAD_INPUT = 2
INTERRUPTED = 130

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    try:
        return _perform(*parse(list(sys.argv[1:] if argv is None else argv)))
    except UserError as error:
        return _refuse(str(error))
    except BrokenPipeError:  # the reader of our output has seen enough, as in `... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # what the machine refuses about a file, its user can mend
        if error.filename is None and error.errno not in _DISK_FULL:
            raise
        return _refuse(f"cannot use '{error.filename or 'the disk'}': {error.strerror}")
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as end:  # tyro has printed the help
        return int(end.code or 0)


def _refuse(message: str) -> int:
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr)
    return BAD_INPUT


def parse(typed: list[str]) -> tuple[Any, Any]:
    """Returns the command, one of `arguments`, and the settings if it is `train`."""
    if typed[:1] == ["train"]:
        return _parse_train(typed[1:])
    with _one_line():
        command: Any = tyro.cli(arguments.Command, prog=PROGRAM, args=typed)  # pyright: ignore
    return (command.action if isinstance(command, arguments.Clips) else command), None


def _parse_train(typed: list[str]) -> tuple[arguments.Train, Any]:
    """Returns the command and the settings: the recipe's or the resumed run's, then the options.

    Which defaults those are depends on what is typed, so it is read twice.
    """
    commands = _commands()
    from jaxskills import recipes

    named = typed and not typed[0].startswith("-")
    recipe = recipes.find(typed[0]) if named else None
    first = _read_train(typed, commands.settings(recipe))
    return first, _read_train(typed, commands.settings_of(first, first.config)).config


def _read_train(typed: list[str], settings: Any) -> Any:
    """Returns `arguments.Train` with one more field, `config`, which starts from `settings`."""
    shown = Annotated[type(settings), conf.arg(name="")]
    config = ("config", shown, dataclasses.field(default=settings))
    kind = dataclasses.make_dataclass("Train", [config], bases=(arguments.Train,), frozen=True)
    with _one_line():
        return tyro.cli(
            kind, prog=f"{PROGRAM} train", args=typed, description=inspect.getdoc(arguments.Train)
        )


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    """Turns the box in which tyro explains a mistake into a `UserError` of one line."""
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            yield
    except SystemExit as end:
        if not end.code:
            raise
        raise UserError(_unboxed(box.getvalue())) from None


def _unboxed(box: str) -> str:
    """Returns the sentences of a box, without its frame, its title and its pointers to help.

    Where standard output is not UTF-8 the frame is of blanks, and the title has rows of its own.
    """
    rows = [row.strip("│ ") for row in box.splitlines() if row[0] not in "╭╰"]
    sections = [[]]
    for row in rows if "│" in box else rows[2:]:
        if set(row) in ({"─"}, {"-"}):
            sections.append([])
        elif row:
            sections[-1].append(row)
    sentences = [" ".join(section) for section in sections]
    return "; ".join(text for text in sentences if "helptext" not in text) or box


def _perform(command: Any, settings: Any) -> int:
    commands = _commands()
    if getattr(command, "json", False):
        with _only_on_stderr():
            answer = commands.perform(command, settings)
        print(json.dumps(answer.data, allow_nan=False), flush=True)
    else:
        answer = commands.perform(command, settings)
        print(answer.text, flush=True)
    return INTERRUPTED if answer.interrupted else 0


def _commands() -> ModuleType:
    """Returns `jaxskills.commands`, and with it imports JAX, which takes a second or two."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / PROGRAM
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    # XLA's threads and a fork do not go together, but what forks here at once becomes ffmpeg.
    warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
    _check_mujoco()
    from jaxskills import commands

    return commands


def _check_mujoco() -> None:
    """Raises a `UserError` if MuJoCo cannot be imported for its choice of a drawing library."""
    asked = os.environ.get("MUJOCO_GL")
    try:
        importlib.import_module("mujoco")
    except (AttributeError, ImportError, RuntimeError) as error:
        if not asked:
            raise
        reason = f"MuJoCo does not work with MUJOCO_GL='{asked}' ({error})"
        raise UserError(f"{reason}: unset it") from None


@contextlib.contextmanager
def _only_on_stderr() -> Iterator[None]:
    """Keeps what libraries print, from C too, out of standard output."""
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
