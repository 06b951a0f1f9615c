# SPDX-License-Identifier: Apache-2.0
"""Films: what a file holds is read back, and pixels are compared where a figure must be."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image

from jaxskills import character as character_lib
from jaxskills import render
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.render import opengl, several, stage, take, video

pytestmark = pytest.mark.timeout(100)

SMALL = (96, 64)
FRAMES = 9
FORWARD = np.array([1.0, 0.0, 0.0])

# A walker of one colour: left and right must be told apart by the studio.
WALKER = """
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    {extra}
    <body name="trunk" pos="0 0 1">
      <freejoint name="root"/>
      <geom type="box" size="0.1 0.15 0.3" pos="0 0 0.3" {paint}/>
      <body name="left_leg" pos="0 0.12 0">
        <joint name="left_hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.9" size="0.08" {paint}/>
      </body>
      <body name="right_leg" pos="0 -0.12 0">
        <joint name="right_hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.9" size="0.08" {paint} {right}/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def _walker(folder: Path, extra: str = "", paint: str = "", right: str = "") -> Character:
    path = folder / "walker.xml"
    path.write_text(WALKER.format(extra=extra, paint=paint, right=right))
    return character_lib.load(str(path))


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return _walker(tmp_path_factory.mktemp("walker"))


@pytest.fixture(scope="module")
def walk(walker: Character) -> np.ndarray:
    """Poses [FRAMES, nq]: 1 m forward, legs swinging."""
    qpos = np.tile(walker.model.qpos0, (FRAMES, 1))
    qpos[:, 0] = np.linspace(0, 1, FRAMES)
    qpos[:, 7] = 0.6 * np.sin(np.linspace(0, 3, FRAMES))
    qpos[:, 8] = -qpos[:, 7]
    return qpos


@pytest.fixture(scope="module")
def gl() -> None:
    try:
        opengl.backend()
    except UserError as missing:
        pytest.skip(str(missing))


def _green(image: np.ndarray) -> int:
    """Pixels of the ghost."""
    return len(_green_columns(image))


def _green_columns(image: np.ndarray) -> np.ndarray:
    """Column of each pixel of the ghost."""
    red, green, blue = np.moveaxis(np.asarray(image, int), -1, 0)
    return np.nonzero((green > red + 25) & (green > blue + 25))[1]


def _decode(path: Path) -> tuple[dict, list[np.ndarray]]:
    stream = imageio_ffmpeg.read_frames(str(path))
    info = next(stream)
    width, height = info["size"]
    return info, [np.frombuffer(one, np.uint8).reshape(height, width, 3) for one in stream]


def test_mp4_has_every_frame_and_plays_everywhere(gl, walker, walk, tmp_path):
    path = render.film(walker, walk, walk, tmp_path / "new" / "walk.MP4", size=(97, 65), fps=30)
    info, frames = _decode(path)
    assert len(frames) == FRAMES
    assert info["size"] == SMALL  # yuv420p has even sizes
    assert info["codec"] == "h264" and info["pix_fmt"].startswith("yuv420p")
    assert info["fps"] == 30
    assert frames[0].std() > 5 and _green(frames[0]) > 20
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_gif_is_in_real_time(gl, walker, walk, tmp_path):
    path = render.film(walker, walk, None, tmp_path / "walk.gif", size=SMALL, fps=30)
    with Image.open(path) as film:
        assert (film.n_frames, film.size) == (5, SMALL)  # type: ignore[attr-defined]
        assert film.info["duration"] == pytest.approx(2000 / 30, abs=7)  # gif counts in 10 ms


def test_ghost_is_beside_or_exactly_there(gl, walker, walk):
    kept = take.checked(walker, walk, walk, [""] * FRAMES, 30.0)
    alone = take.checked(walker, walk, None, [""] * FRAMES, 30.0)
    beside, over, none = (
        np.array(next(video.frames(one, (160, 120), overlay)))
        for one, overlay in ((kept, False), (kept, True), (alone, False))
    )
    assert _green(none) == 0
    assert _green(beside) > 100
    assert _green(over) > 100
    figure = np.nonzero(np.abs(over.astype(int) - none).max(2) > 20)[1]
    assert _green_columns(over).mean() == pytest.approx(figure.mean(), abs=5)
    # Beside it the ghost stands in the other half, and the simulation makes room.
    assert _green_columns(beside).mean() > _green_columns(over).mean() + 10


def _cells(walker: Character, walk: np.ndarray) -> list[list[render.Cell]]:
    """Three performances in two rows; the second one is shorter, the third one has a red leg."""
    spec = mujoco.MjSpec.from_file(walker.source)
    for geom in spec.body("left_leg").geoms:
        geom.rgba = np.array([1.0, 0.0, 0.0, 1.0])
    other = dataclasses.replace(walker, model=spec.compile())
    first = render.Cell(walker, walk, walk, "slow")
    second = render.Cell(walker, walk[:4], walk[:4], "fast")
    return [[first, second], [render.Cell(other, walk, None, "red")]]


def test_a_grid_shows_all_at_a_time(gl, walker, walk, tmp_path):
    path = render.grid(_cells(walker, walk), tmp_path / "grid.mp4", size=SMALL)
    info, frames = _decode(path)
    assert info["size"] == (2 * SMALL[0], 2 * SMALL[1]) and len(frames) == FRAMES
    last = [frame.astype(int) for frame in (frames[4], frames[-1])]
    left, right = np.s_[: SMALL[1], : SMALL[0]], np.s_[: SMALL[1], SMALL[0] :]
    assert np.abs(last[0][left] - last[1][left]).max() > 50
    assert np.abs(last[0][right] - last[1][right]).max() < 30  # it waits; codecs are not exact
    below = frames[0][SMALL[1] :]
    assert _green(below) == 0 and below[:, SMALL[0] :].min() > 240  # no fourth one
    assert _green(frames[0][left]) > 20 and _green(frames[0][right]) > 20


def test_a_grid_draws_each_with_its_own_model(gl, walker, walk):
    takes = several.takes(_cells(walker, walk), 30.0)
    picture = np.array(next(several.frames(takes, (160, 120))), int)
    red = (picture[..., 0] > picture[..., 1] + 60) & (picture[..., 0] > picture[..., 2] + 60)
    assert red[120:, :160].sum() > 20 and not red[:120].any()


def test_a_grid_of_strips(gl, walker, walk, tmp_path):
    options = {"size": (303, 0), "panels": 3}
    path = render.grid(_cells(walker, walk), tmp_path / "grid.png", **options)
    strip = np.array(Image.open(path), int)
    tall = (strip.shape[0] - 2 * 3) // 3
    rows = [strip[i * (tall + 3) : i * (tall + 3) + tall] for i in range(3)]
    assert strip.shape[0] == 3 * tall + 2 * 3
    assert _green(rows[0]) > 20 and _green(rows[1]) > 20 and _green(rows[2]) == 0


def test_a_grid_of_nothing(walker, tmp_path):
    with pytest.raises(UserError, match="a grid of no performances"):
        render.grid([[]], tmp_path / "grid.mp4")
    with pytest.raises(UserError, match="unknown film format '.avi'"):
        render.grid([[]], tmp_path / "grid.avi")


def test_strip_has_its_panels_and_the_character_moves(gl, walker, walk, tmp_path):
    silent = {"labels": [""] * FRAMES, "fps": 10.0, "size": (300, 0)}
    still = np.tile(walk[0], (FRAMES, 1))
    seen = {}
    for name, qpos in (("walk", walk), ("still", still)):
        path = render.film(walker, qpos, None, tmp_path / f"{name}.png", panels=4, **silent)
        strip = np.array(Image.open(path), int)
        assert strip.shape[1] == pytest.approx(300, abs=4)
        wide = (strip.shape[1] - 3 * 3) // 4
        seen[name] = [strip[:, i * (wide + 3) : i * (wide + 3) + wide] for i in range(4)]
    changes = {name: np.abs(p[1] - p[0]).mean() for name, p in seen.items()}
    assert changes["still"] == 0.0
    assert changes["walk"] > 2.0


def test_strip_shows_the_reference_above_and_follows_both(gl, walker, walk, tmp_path):
    glide = np.tile(walk[0], (FRAMES, 1))
    glide[:, 1] = np.linspace(0, 2, FRAMES)
    options = {"size": (303, 0), "panels": 3, "labels": [""] * FRAMES}
    path = render.film(walker, glide - np.eye(9)[0], glide, tmp_path / "w.png", **options)
    strip = np.array(Image.open(path), int)[:, 99 + 3 :]  # the first panels hold the rows' names
    upper, gap, lower = np.split(strip, [len(strip) // 2 - 1, len(strip) // 2 + 2])
    assert len(upper) == len(lower) and gap.min() == 255
    assert _green(upper) > 300 and _green(lower) == 0
    places = [_green_columns(upper[:, at : at + 99]).mean() for at in (0, 102)]
    assert places == pytest.approx([49.0, 49.0], abs=8) and abs(places[0] - places[1]) < 1
    # The same poses in the same places: beige and slate instead of green.
    differs = np.abs(lower - upper).max(2) > 40
    assert differs[:, :99].sum() > 150 and not differs[:10].any()


def test_strip_covers_two_cycles_or_four_seconds(gl, walker, tmp_path, monkeypatch):
    qpos = np.tile(walker.model.qpos0, (61, 1))
    written: list[str] = []
    monkeypatch.setattr(render.strip, "_write", lambda panel, label, name: written.append(label))
    options = {"fps": 10.0, "size": (90, 0), "panels": 3}
    render.film(walker, qpos, None, tmp_path / "a.png", cycle=1.5, **options)
    render.film(walker, qpos, None, tmp_path / "b.png", **options)
    render.film(walker, qpos[:11], None, tmp_path / "c.png", **options)
    assert written == [
        *("0.00 s", "1.50 s", "3.00 s"),
        *("0.00 s", "2.00 s", "4.00 s"),
        *("0.00 s", "0.50 s", "1.00 s"),
    ]


def test_film_ends_where_the_simulation_diverged(gl, walker, walk, tmp_path):
    broken = walk.copy()
    broken[4:, 3] = np.nan
    broken[6, 2] = np.inf
    path = render.film(walker, broken, walk, tmp_path / "walk.mp4", size=SMALL)
    assert len(_decode(path)[1]) == 4


def _front(character: Character, **poses) -> np.ndarray:
    """Picture from the front, where the left side is on the right."""
    lens = stage.Lens(azimuth=180.0, elevation=-5.0, distance=6.0, fovy=25.0)
    with stage.opened(character.model, FORWARD, lens, 120, 120) as studio:
        return stage.picture(studio, np.array([0.0, 0.0, 0.9]), **poses).astype(int)


def test_left_and_right_differ_unless_the_author_saw_to_it(gl, walker, tmp_path):
    def legs(character: Character) -> tuple[np.ndarray, np.ndarray]:
        image = _front(character, qpos=character.model.qpos0)
        return image[75, 53], image[75, 67]  # right, left

    right, left = legs(walker)
    assert left.sum() > right.sum() + 100
    one_red = _walker(tmp_path, right='rgba="0.8 0.1 0.1 1"')
    right, _ = legs(one_red)
    assert right[0] > right[1] + 80
    all_red = _walker(tmp_path, paint='rgba="0.8 0.1 0.1 1"')
    right, left = legs(all_red)
    assert left.sum() > right.sum() + 100


@pytest.mark.parametrize("distance", [3.0, 20.0, 100.0])
def test_all_around_is_floor_or_air(gl, walker, distance):
    lens = stage.Lens(azimuth=180.0, elevation=-8.0, distance=distance, fovy=15.0)
    with stage.opened(walker.model, FORWARD, lens, 60, 100) as studio:
        for height in (0.0, 5.0, 20.0):
            found = stage.picture(studio, np.array([0.0, 0.0, height]), None)
            assert found.min() > 150


def test_only_the_character_has_a_ghost(gl, walker, tmp_path):
    box = '<geom type="box" size="0.2 0.2 0.2" pos="0 0.7 0.2" rgba="1 0 0 1"/>'
    with_box = _walker(tmp_path, extra=box)
    image = _front(with_box, qpos=with_box.model.qpos0)
    assert (image[..., 0] > image[..., 1] + 80).sum() > 50
    ghost = _front(with_box, qpos=None, ghost=with_box.model.qpos0)
    alone = _front(walker, qpos=None, ghost=walker.model.qpos0)
    assert (ghost[..., 0] > ghost[..., 1] + 80).sum() > 50
    assert _green(ghost) == _green(alone) > 100


def test_reach_and_stature(walker):
    qpos = walker.model.qpos0.copy()
    assert stage.stature(walker.model, FORWARD) == pytest.approx(0.98 + 0.6)
    # Its length counts, its width does not.
    lying = mujoco.MjModel.__copy__(walker.model)
    lying.qpos0[3:7] = np.sqrt(0.5), 0, np.sqrt(0.5), 0
    assert stage.stature(lying, FORWARD) == pytest.approx(0.98 + 0.6)
    assert stage.stature(lying, np.eye(3)[1]) == pytest.approx(0.4)
    assert stage.reach(walker.model, qpos, np.eye(3)[1]) == pytest.approx((-0.2, 0.2))
    qpos[7] = -np.pi / 2  # the left leg points forward
    assert stage.reach(walker.model, qpos, np.eye(3)[0]) == pytest.approx((-0.1, 0.98))
    qpos[:2] = 5.0, 7.0
    assert stage.reach(walker.model, qpos, np.eye(3)[0]) == pytest.approx((4.9, 5.98))


def test_reach_of_a_mesh_covers_its_corners():
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 0.5]])
    text = " ".join(str(x) for x in corners.ravel())
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco>
        <asset><mesh name="m" vertex="{text}"/></asset>
        <worldbody><body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>
      </mujoco>""")
    # The box around it is in the mesh's own axes, so it may be larger, but not by much.
    for axis, corner in zip(np.eye(3), corners.T, strict=True):
        low, high = stage.reach(model, model.qpos0, axis)
        assert -1.2 < low <= corner.min() + 1e-6 and corner.max() - 1e-6 <= high < 3.6


def test_camera_follows_steady_motion_exactly_and_evens_out_the_rest(walker, walk):
    kept = take.checked(walker, walk, None, None, 30.0)
    assert np.allclose(take.lookat(kept, walk), walk[:, :3], atol=1e-12)
    shaken = walk.copy()
    shaken[:, 1] += 0.1 * (-1.0) ** np.arange(FRAMES)
    assert np.abs(np.diff(take.lookat(kept, shaken)[:, 1])).max() < 0.02


def test_ghost_goes_at_the_left_and_is_pulled_along(walker, walk):
    ahead = walk + np.eye(9)[0] * 0.1
    kept = take.checked(walker, walk, ahead, None, 30.0)
    assert kept.heading == pytest.approx(0.0)
    aside = 0.8 * kept.body
    assert np.allclose((take.beside(kept, ahead) - walk)[:, :2], [0.1, aside])
    far = walk + np.eye(9)[0] * 10.0
    assert np.allclose((take.beside(kept, far) - walk)[:, :2], [0.3 * kept.body, aside])


def test_heading_is_the_way_or_the_facing(walker, walk):
    aside = walk.copy()
    aside[:, [0, 1]] = walk[:, [1, 0]]
    assert take.checked(walker, aside, None, None, 30.0).heading == pytest.approx(np.pi / 2)
    turned = np.tile(walk[0], (3, 1))
    turned[:, 3:7] = np.cos(np.pi / 3), 0, 0, np.sin(np.pi / 3)
    assert take.checked(walker, turned, None, None, 30.0).heading == pytest.approx(2 * np.pi / 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": "w.avi"}, "unknown film format '.avi': choose one of .mp4, .gif, .png"),
        ({"qpos": np.zeros((3, 4))}, r"qpos has shape \(3, 4\): walker needs \(T, 9\), T > 0"),
        ({"qpos": np.zeros((0, 9))}, r"qpos has shape \(0, 9\): walker needs \(T, 9\), T > 0"),
        ({"qpos": np.full((3, 9), np.nan)}, "nothing to film: the first pose is not finite"),
        ({"reference_qpos": np.zeros((2, 9))}, "reference_qpos has 2 poses: qpos has 9"),
        ({"labels": ["a"]}, "there are 1 labels: qpos has 9 poses"),
        ({"fps": 0.0}, "fps is 0.0: give a number > 0"),
        ({"size": (8, 8)}, "a film of 8 x 8 pixels"),
    ],
)
def test_bad_input_is_named(walker, walk, tmp_path, change, message):
    given = {"qpos": walk, "reference_qpos": None, "path": "w.mp4"} | change
    given["path"] = tmp_path / given["path"]
    with pytest.raises(UserError, match=f"^{message}"):
        render.film(walker, **given)
    assert not list(tmp_path.iterdir())


def test_without_gl_one_line_names_the_package(walker, walk, tmp_path, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    # PyOpenGL then refuses EGL and OSMesa alike, as where neither library is installed.
    monkeypatch.setenv("PYOPENGL_PLATFORM", "none")
    opengl._works.cache_clear()
    try:
        with pytest.raises(UserError, match="apt-get install libegl1.*libosmesa6") as caught:
            render.film(walker, walk, None, tmp_path / "walk.mp4", size=SMALL)
    finally:
        opengl._works.cache_clear()
    assert "\n" not in str(caught.value)


def test_without_ffmpeg_one_line_says_so(walker, walk, tmp_path, monkeypatch):
    def missing() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    with pytest.raises(UserError, match="no ffmpeg: run pip install .*imageio-ffmpeg"):
        render.film(walker, walk, None, tmp_path / "walk.mp4", size=SMALL)


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are Linux's")
@pytest.mark.parametrize(
    ("asked", "works", "answer"),
    [
        ("", {"egl", "osmesa"}, "egl"),
        ("", {"osmesa"}, "osmesa"),
        ("1", {"osmesa"}, "osmesa"),
        ("OSMesa", {"egl", "osmesa"}, "osmesa"),
        ("glx", {"glfw"}, "glfw"),
        ("", set(), "cannot render: no egl or osmesa here: run apt-get install libegl1"),
        ("osmesa", {"egl"}, "MUJOCO_GL='osmesa' does not work here: unset it, or run"),
        ("off", {"egl"}, "MUJOCO_GL='off' switches rendering off: unset it"),
        ("vulkan", {"egl"}, "unknown MUJOCO_GL 'vulkan': choose one of egl, osmesa, glfw"),
    ],
)
def test_which_library_draws(monkeypatch, asked, works, answer):
    monkeypatch.setenv("MUJOCO_GL", asked)
    monkeypatch.setattr(opengl, "_works", works.__contains__)
    if " " not in answer:
        assert opengl.backend() == answer
    else:
        with pytest.raises(UserError, match=f"^{answer}"):
            opengl.backend()


_OTHER = """
import sys, mujoco, numpy as np
from jaxskills.render import opengl, stage
model = mujoco.MjModel.from_xml_path(sys.argv[1])
with stage.opened(model, np.eye(3)[0], stage.Lens(180.0, -5.0, 6.0, 25.0), 120, 120) as studio:
    np.save(sys.argv[2], stage.picture(studio, np.array([0.0, 0.0, 0.9]), model.qpos0))
print(opengl.backend())
"""


@pytest.mark.parametrize("library", ["egl", "osmesa"])
def test_each_library_draws_the_same(walker, tmp_path, library):
    """In processes of their own: one process can load but one of them."""
    environment = os.environ | {"MUJOCO_GL": library}
    environment.pop("PYOPENGL_PLATFORM", None)
    command = [sys.executable, "-c", _OTHER, walker.source, str(tmp_path / "picture.npy")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    # Where the library is missing, `import mujoco` itself may fail.
    if "does not work here" in done.stderr or "has no attribute 'glGetError'" in done.stderr:
        pytest.skip(f"no {library} on this machine")
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, library, "")
    image = np.load(tmp_path / "picture.npy").astype(int)
    assert image[75, 67].sum() > image[75, 53].sum() + 100
    assert image[5, 5].min() > 200  # the backdrop


def test_models_are_left_as_they_are(gl, walker, walk, tmp_path):
    before = mujoco.MjModel.__copy__(walker.model)
    render.film(walker, walk, walk, tmp_path / "w.png", size=(64, 0), panels=1)
    for name in ("geom_rgba", "geom_matid", "geom_group"):
        assert np.array_equal(getattr(before, name), getattr(walker.model, name))
    assert before.vis.global_.offwidth == walker.model.vis.global_.offwidth
