# SPDX-License-Identifier: Apache-2.0
"""The file of bounds: what is written is read back, and what is wrong is named in one line."""

import tomllib
from pathlib import Path

import pytest
import tiny

from jaxskills.character import Character
from jaxskills.env import bounds, bounds_file
from jaxskills.env.bounds import BoundsConfig
from jaxskills.errors import UserError

CHANGED = BoundsConfig(
    com=(0.1, 0.25, float("inf")),
    root=1.0,
    joints=1e-3,
    end_effectors=2.0,
    channels={
        "com_z": ((0.0, 0.2), (0.35, 0.5), (1.0, 0.2)),
        "spine": (0.1, 0.2, 0.3),
        "left_leg_position": 0.75,
    },
    no_ground_contact=("torso", "pelvis"),
)


@pytest.mark.parametrize("config", [BoundsConfig(), CHANGED], ids=["defaults", "changed"])
def test_what_is_written_is_read_back(who: Character, tmp_path: Path, config: BoundsConfig):
    bounds_file.write(tmp_path / "my.toml", who, config)
    assert bounds_file.read(tmp_path / "my.toml", who) == config


def test_every_channel_stands_there_with_size_and_unit(who: Character):
    rows = bounds_file.text(who, BoundsConfig()).splitlines()
    for row in ("# com_z = 0.2  # m", "# root = 0.7  # rad", "# torso_position = 0.5  # m"):
        assert row in rows
    tail = rows[rows.index("[channels]") + 1 :]
    assert [row.split()[1] for row in tail] == list(bounds.channel_names(who))
    assert "# pelvis, torso, left_leg, right_leg" in rows


def test_a_row_counts_once_its_mark_is_removed(who: Character, tmp_path: Path):
    text = bounds_file.text(who, BoundsConfig()).replace("# spine = 0.7", "spine = 0.9")
    (tmp_path / "my.toml").write_text(text)
    found = bounds_file.read(tmp_path / "my.toml", who)
    assert found == BoundsConfig(channels={"spine": 0.9})


def test_names_that_are_no_plain_keys(tmp_path: Path):
    xml = tiny.write_character(tmp_path)
    for path in (xml, xml.with_suffix(".toml")):
        path.write_text(path.read_text().replace("spine", "spine.é x"))
    toml = xml.with_suffix(".toml")
    toml.write_text(toml.read_text().replace("spine.é x =", '"spine.é x" ='))
    other = tiny.character.load(str(xml))
    config = BoundsConfig(channels={"spine.é x": 0.5})
    assert tomllib.loads(bounds_file.text(other, config))["channels"] == {"spine.é x": 0.5}


def test_a_part_left_out_has_its_default(who: Character, tmp_path: Path):
    (tmp_path / "my.toml").write_text("joints = 1\n")
    assert bounds_file.read(tmp_path / "my.toml", who) == BoundsConfig(joints=1.0)


def test_a_file_is_not_overwritten(who: Character, tmp_path: Path):
    path = tmp_path / "my.toml"
    path.write_text("joints = 1\n")
    with pytest.raises(UserError, match="my.toml' exists: name another file$"):
        bounds_file.write(path, who, BoundsConfig())
    assert path.read_text() == "joints = 1\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("joints = ", "is not valid TOML: "),
        ("joints = 1\njoints = 2", "is not valid TOML: "),
        ("jionts = 1", "unknown entry 'jionts': choose one of com, root, joints, end_effectors"),
        ("com = 0.3", "com is 0.3: give three sizes in m, for x, y and up"),
        ("com = [0.3, 0.3]", "com is [0.3, 0.3]: give three sizes"),
        ("com = [0.3, 0.3, -1]", "bound com_z is -1.0: give positive sizes"),
        ("joints = 0", "bound spine is 0.0: give positive sizes"),
        ("joints = nan", "bound spine is nan: give positive sizes"),
        ("joints = '1'", "joints is 1: give a number here, knots in [channels]"),
        ("joints = true", "joints is True: give a number"),
        ("root = [[0, 1], [1, 2]]", "root is [[0, 1], [1, 2]]: give a number here, knots in"),
        ("channels = 3", "channels is 3: give a table, [channels]"),
        ("[channels]\nspien = 1", "unknown bound 'spien': choose one of com_x, com_y"),
        ("[channels]\nspine = -0.1", "bound spine is -0.1: give positive sizes"),
        ("[channels]\nspine = []", "bound spine is []: give a size, or knots [share, size]"),
        ("[channels]\nspine = 'wide'", "bound spine is wide: give a size, or knots"),
        ("[channels]\nspine = [[0.0, 1.0], 2.0]", "bound spine is [[0.0, 1.0], 2.0]: give a size"),
        ("[channels]\nspine = [[0.0, 1.0, 2.0]]", "bound spine is [[0.0, 1.0, 2.0]]: give a size"),
        ("[channels]\nspine = [[0.0, 1.0], [0.5, 0.0]]", "bound spine is ((0.0, 1.0), (0.5, 0.0))"),
        ("[channels]\nspine = [[0.5, 1.0], [0.4, 1.0]]", "bound spine has knots at 0.5, 0.4: give"),
        ("no_ground_contact = 'torso'", "no_ground_contact is torso: give a list of bodies' names"),
        ("no_ground_contact = ['head']", "unknown body of walker 'head': choose one of pelvis"),
    ],
)
def test_what_is_wrong_is_named(who: Character, tmp_path: Path, text: str, says: str):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(UserError) as raised:
        bounds_file.read(path, who)
    message = str(raised.value)
    assert message.startswith(f"bounds file '{path}'") and says in message
    assert "\n" not in message


def test_what_is_no_file_is_refused(who: Character, tmp_path: Path):
    (tmp_path / "film.toml").write_bytes(bytes(range(256)))
    for name, says in (("none.toml", "does not exist"), ("film.toml", "is not valid TOML")):
        with pytest.raises(UserError, match=says):
            bounds_file.read(tmp_path / name, who)
