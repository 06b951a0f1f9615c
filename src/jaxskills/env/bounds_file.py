# SPDX-License-Identifier: Apache-2.0
"""Spacetime bounds as a TOML file that a person edits: written to start from, and read."""

import json
import re
import textwrap
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxskills import paths
from jaxskills.character import Character
from jaxskills.env import bounds
from jaxskills.env.bounds import BoundsConfig, Size
from jaxskills.errors import UserError, unknown

SUFFIXES = (".toml",)

_ENTRIES = ("com", "root", "joints", "end_effectors", "no_ground_contact", "channels")
_WIDTH = 100

_HEAD = """\
# Spacetime bounds of {name}: how far it may be from the clip before a training episode ends.
# Learn with them:  jaxskills train SKILL --bounds.file THIS_FILE
# Larger bounds leave more freedom, smaller ones keep closer to the clip; inf switches one off.

# Centre of mass, in m: along x, along y, up.
com = {com}
# Orientation of the root, in rad.
root = {root}
# Rotation of each joint, in rad.
joints = {joints}
# Place of each end effector, in m, seen from the ground under the root along its heading.
end_effectors = {end_effectors}

# Bodies that must not touch the ground, whatever the sizes allow. There are:
{bodies}
no_ground_contact = {no_ground_contact}

# Single bounds with a size of their own: remove the # in front of one to change it. A size may
# also change over the clip, as in [[0.0, 0.2], [0.35, 0.5], [1.0, 0.2]]: pairs of a share of the
# clip, from 0 where it starts to 1 where it ends, and the size there, linear in between.
[channels]
"""


def write(path: Path, character: Character, config: BoundsConfig) -> None:
    """Writes the bounds of a configuration, with all names and units of the character.

    Raises:
      UserError: the file exists; it may hold what somebody has edited.
    """
    if path.exists():
        raise UserError(f"'{path}' exists: name another file")
    paths.write_whole(path, text(character, config))


def text(character: Character, config: BoundsConfig) -> str:
    """Returns what `write` writes; `read` gives the same configuration back."""
    bodies = textwrap.fill(", ".join(character.body_names), _WIDTH - 2)
    head = _HEAD.format(
        name=character.name,
        com=_size(config.com),
        root=_size(config.root),
        joints=_size(config.joints),
        end_effectors=_size(config.end_effectors),
        bodies=textwrap.indent(bodies, "# "),
        no_ground_contact=f"[{', '.join(_quoted(name) for name in config.no_ground_contact)}]",
    )
    rows = [
        f"{_key(name)} = {_size(config.channels[name])}  # {unit}"
        if name in config.channels
        else f"# {_key(name)} = {_size(size)}  # {unit}"
        for name, unit, size in zip(
            bounds.channel_names(character),
            bounds.channel_units(character),
            bounds.default_sizes(character, config),
            strict=True,
        )
    ]
    return head + "\n".join(rows) + "\n"


def read(path: Path, character: Character) -> BoundsConfig:
    """Returns the bounds of a file; what it leaves out has the default size.

    Raises:
      UserError: no such file, not TOML, an unknown entry, channel or body, a size that is not
        positive, knots out of order. The message names the file.
    """
    if not path.is_file():
        raise UserError(f"bounds file '{path}' does not exist")
    try:
        config = _config(tomllib.loads(path.read_text(encoding="utf-8")))
        bounds.table(character, config)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"bounds file '{path}' is not valid TOML: {error}") from None
    except UnicodeDecodeError:
        raise UserError(f"bounds file '{path}' is not valid TOML: it is not text") from None
    except UserError as error:
        raise UserError(f"bounds file '{path}': {error}") from None
    return config


def _config(raw: dict[str, Any]) -> BoundsConfig:
    for name in raw:
        if name not in _ENTRIES:
            raise unknown("entry", name, _ENTRIES)
    found: dict[str, Any] = dict(raw)
    if "com" in raw:
        found["com"] = _numbers(raw["com"])
        if found["com"] is None or len(found["com"]) != 3:
            raise UserError(f"com is {raw['com']}: give three sizes in m, for x, y and up")
    for name in ("root", "joints", "end_effectors"):
        if name in raw:
            found[name] = _number(raw[name])
            if found[name] is None:
                raise UserError(f"{name} is {raw[name]}: give a number here, knots in [channels]")
    bodies = raw.get("no_ground_contact", [])
    if not isinstance(bodies, list) or not all(isinstance(body, str) for body in bodies):
        raise UserError(f"no_ground_contact is {bodies}: give a list of bodies' names")
    found["no_ground_contact"] = tuple(bodies)
    channels = raw.get("channels", {})
    if not isinstance(channels, dict):
        raise UserError(f"channels is {channels}: give a table, [channels]")
    found["channels"] = {name: _channel(name, size) for name, size in channels.items()}
    return BoundsConfig(**found)


def _channel(name: str, raw: Any) -> Size:
    """Returns a number, evenly spread numbers, or knots."""
    one, several = _number(raw), _numbers(raw)
    if one is not None:
        return one
    if several:
        return several
    pairs = [_numbers(pair) for pair in raw] if isinstance(raw, list) else []
    knots = tuple((pair[0], pair[1]) for pair in pairs if pair is not None and len(pair) == 2)
    if not knots or len(knots) < len(pairs):
        raise UserError(f"bound {name} is {raw}: give a size, or knots [share, size]")
    return knots


def _number(raw: Any) -> float | None:
    plain = isinstance(raw, int | float) and not isinstance(raw, bool)
    return float(raw) if plain else None


def _numbers(raw: Any) -> tuple[float, ...] | None:
    found = [_number(item) for item in raw] if isinstance(raw, list) else [None]
    return None if None in found else tuple(item for item in found if item is not None)


def _size(size: float | Sequence[Any]) -> str:
    if isinstance(size, Sequence):
        return f"[{', '.join(_size(item) for item in size)}]"
    return repr(float(size))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)
