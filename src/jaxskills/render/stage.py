# SPDX-License-Identifier: Apache-2.0
"""A photo studio for characters: checkered floor, plain backdrop, one light, one camera, a ghost.

Everything but the character and what stands around it comes from here, as geoms added to MuJoCo's
scene, so every MJCF looks the same and needs no floor texture, sky or light of its own.
"""

import contextlib
import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from jaxskills.render import opengl

# Seen right away: right limbs are dark, left limbs and the trunk light.
LIGHT = (0.87, 0.83, 0.77, 1.0)
DARK = (0.36, 0.45, 0.56, 1.0)
GHOST = (0.30, 0.78, 0.42, 0.4)

_AIR = (0.95, 0.955, 0.96, 1.0)
_TILES = (0.85, 0.86, 0.88, 1.0), (1.0, 1.0, 1.0, 1.0)

_SUN = np.array([0.25, 0.15, -1.0])  # where its light goes, in the camera's right, forward, up
_HIDDEN = 5  # geom group that is never drawn
_VISIBLE_GROUPS = 3  # MuJoCo draws groups 0, 1, 2 unless told otherwise
_MAX_TILES = 2000
UP = np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera but for the point it looks at. Angles in degrees, distance in m."""

    azimuth: float  # 0 looks along x, 90 along y
    elevation: float
    distance: float
    fovy: float  # vertical field of view

    @property
    def forward(self) -> np.ndarray:
        """Horizontal unit vector [3] into the picture."""
        angle = np.radians(self.azimuth)
        return np.array([np.cos(angle), np.sin(angle), 0.0])

    @property
    def right(self) -> np.ndarray:
        """Unit vector [3] to the right of the picture."""
        return np.cross(self.forward, UP)


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """What one picture after another is drawn with; made by `opened`."""

    solid: mujoco.MjData
    ghost: mujoco.MjData
    scenery: mujoco.MjData
    lens: Lens
    width: int
    height: int
    body: float  # m, stature of the character
    floor: float  # m
    scene: mujoco.MjvScene
    context: mujoco.MjrContext
    gl: Any  # the OpenGL context, which may be one of several


@contextlib.contextmanager
def opened(
    model: mujoco.MjModel, forward: np.ndarray, lens: Lens, width: int, height: int
) -> Iterator[Stage]:
    """Yields a stage and frees its graphics memory afterwards.

    Args:
      model: the character, and what stands around it.
      forward: [3] its facing at the zero pose, which tells left from right.
      lens: the camera.
      width: of the pictures, in pixels.
      height: likewise.

    Raises:
      UserError: this machine cannot render (see `opengl.backend`).
    """
    solid, ghost = _solid(model, forward), _ghost(model)
    body = stature(model, forward)
    look = solid.vis
    look.global_.offwidth, look.global_.offheight, look.global_.fovy = width, height, lens.fovy
    # Without a graphics card corners cost most: these look round enough and take half the time.
    look.quality.numslices, look.quality.numstacks, look.quality.numquads = 16, 8, 1
    look.quality.shadowsize, look.quality.offsamples = 2048, 4
    solid.stat.extent = 1.0  # so that the following are metres
    far = _far(lens, body)
    look.map.znear, look.map.zfar = 0.05 * lens.distance, 2.0 * far  # behind all of the backdrop
    look.map.fogstart, look.map.fogend = lens.distance + body, far
    look.map.shadowclip = 1.6 * body
    look.rgba.fog[:] = _AIR
    floor = float(min(model.geom_pos[_floors(model), 2], default=0.0))
    with contextlib.ExitStack() as last_first:
        gl = opengl.context(width, height)
        last_first.callback(gl.free)
        context = mujoco.MjrContext(solid, mujoco.mjtFontScale.mjFONTSCALE_100)
        last_first.callback(context.free)
        last_first.callback(gl.make_current)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        scene = mujoco.MjvScene(solid, maxgeom=2 * model.ngeom + _MAX_TILES + 1000)
        figures = mujoco.MjData(solid), mujoco.MjData(ghost), mujoco.MjData(_scenery(solid))
        yield Stage(*figures, lens, width, height, body, floor, scene, context, gl)


def picture(
    stage: Stage, lookat: np.ndarray, qpos: np.ndarray | None, ghost: np.ndarray | None = None
) -> np.ndarray:
    """Returns an image, uint8 [height, width, 3].

    Args:
      stage: see `opened`.
      lookat: [3] m, the middle of the picture.
      qpos: [nq] pose of the solid character; None leaves it out.
      ghost: [nq] pose of the translucent one; None leaves it out.
    """
    stage.gl.make_current()
    scene = stage.scene
    scene.ngeom = 0
    if qpos is None:
        _add_figure(scene, stage.scenery, stage.scenery.model.qpos0)
    for data, pose in ((stage.solid, qpos), (stage.ghost, ghost)):
        if pose is not None:
            _add_figure(scene, data, pose)
    _add_ground(stage, lookat)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = lookat
    camera.distance = stage.lens.distance
    camera.azimuth, camera.elevation = stage.lens.azimuth, stage.lens.elevation
    mujoco.mjv_updateCamera(stage.solid.model, stage.solid, camera, scene)
    _set_lights(stage, lookat)
    scene.flags[:] = 0
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_FOG):
        scene.flags[flag] = 1
    whole = mujoco.MjrRect(0, 0, stage.width, stage.height)
    pixels = np.empty((stage.height, stage.width, 3), np.uint8)
    mujoco.mjr_render(whole, scene, stage.context)
    mujoco.mjr_readPixels(pixels, None, whole, stage.context)
    return np.ascontiguousarray(pixels[::-1])


def stature(model: mujoco.MjModel, forward: np.ndarray) -> float:
    """Returns the height or length in m of the character at its zero pose, whichever is larger.

    Its width does not count: many robots start with their arms stretched out.
    """
    low, high = np.array([reach(model, model.qpos0, axis) for axis in (UP, forward)]).T
    return float((high - low).max())


def reach(model: mujoco.MjModel, qpos: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
    """Returns the smallest and largest coordinate in m of the character along a unit vector [3]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    frames = data.geom_xmat.reshape(-1, 3, 3)
    middle = data.geom_xpos + np.einsum("gij,gj->gi", frames, model.geom_aabb[:, :3])
    half = np.abs(np.einsum("gij,i->gj", frames, direction)) * model.geom_aabb[:, 3:]
    along, spread = middle @ direction, half.sum(1)
    seen = _character(model) & (model.geom_group < _VISIBLE_GROUPS)
    seen = seen if seen.any() else _character(model)
    return float((along - spread)[seen].min()), float((along + spread)[seen].max())


def _character(model: mujoco.MjModel) -> np.ndarray:
    """Returns [ngeom]: is it part of the character, not of the ground or an object."""
    return model.body_rootid[model.geom_bodyid] == model.body_rootid[model.jnt_bodyid[0]]


def _floors(model: mujoco.MjModel) -> np.ndarray:
    """Returns [ngeom]: is it a level plane of the world."""
    planes = (model.geom_bodyid == 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    return planes & (np.abs(model.geom_quat[:, 1:3]).max(1) < 1e-6)


def _solid(model: mujoco.MjModel, forward: np.ndarray) -> mujoco.MjModel:
    """Returns a copy without its floor, and painted where left and right look the same."""
    copied = copy.copy(model)
    copied.geom_group[_floors(model)] = _HIDDEN
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = data.xpos[model.jnt_bodyid[0]]
    side = (data.geom_xpos - root) @ np.cross(UP, forward)
    material = model.geom_matid
    colour = np.where((material < 0)[:, None], model.geom_rgba, _of(model.mat_rgba, material))
    tolerance, body = 0.01 * stature(model, forward), _character(model)
    left, right = body & (side > tolerance), body & (side < -tolerance)
    if {*map(tuple, colour[left])} == {*map(tuple, colour[right])}:
        copied.geom_matid[body] = -1
        copied.geom_rgba[body] = LIGHT
        copied.geom_rgba[right] = DARK
    return copied


def _of(table: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Returns rows of a table that may be empty; a negative index gives any row."""
    return table[index] if len(table) else np.zeros((len(index), 4))


def _ghost(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of which only the character is seen, translucent."""
    copied = copy.copy(model)
    copied.geom_group[~_character(model)] = _HIDDEN
    copied.geom_matid[:] = -1
    copied.geom_rgba[:] = GHOST
    return copied


def _scenery(solid: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of which only what never moves is seen."""
    copied = copy.copy(solid)
    copied.geom_group[solid.body_weldid[solid.geom_bodyid] != 0] = _HIDDEN
    return copied


def _add_figure(scene: mujoco.MjvScene, data: mujoco.MjData, qpos: np.ndarray) -> None:
    model = data.model
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_tendon(model, data)
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), everything, scene)


def _add_ground(stage: Stage, lookat: np.ndarray) -> None:
    """Adds the tiles that the camera sees, as far as the fog lets it, and the backdrop behind."""
    lens, level = stage.lens, np.eye(3)
    far = _far(lens, stage.body)
    eye = np.append(lookat[:2], 0.0) - lens.distance * lens.forward
    size = 0.5 * 2.0 ** round(np.log2(stage.body / 1.6))  # half a metre for a human
    count = int(far / size) + 2
    cell = np.stack(np.meshgrid(*[np.arange(-count, count)] * 2), -1).reshape(-1, 2)
    cell += np.floor(eye[:2] / size).astype(int)
    centre = (cell + 0.5) * size
    ahead, aside = (centre - eye[:2]) @ lens.forward[:2], (centre - eye[:2]) @ lens.right[:2]
    slope = np.tan(np.radians(lens.fovy / 2)) * stage.width / stage.height
    seen = (ahead > -size) & (ahead < far) & (np.abs(aside) < 1.1 * slope * ahead + 2 * size)
    for (x, y), odd in zip(centre[seen][:_MAX_TILES], (cell.sum(1) % 2)[seen], strict=False):
        _add_plane(stage.scene, np.array([x, y, stage.floor]), level, size / 2, _TILES[odd])
    # Beyond the end of the fog, so that it has the colour of the air whatever the light.
    upright = np.stack([-lens.right, UP, -lens.forward], 1)
    _add_plane(stage.scene, eye + 1.3 * far * lens.forward, upright, 3 * far, _AIR)


def _far(lens: Lens, body: float) -> float:
    """Returns how far away (m) there is nothing but air."""
    return lens.distance + 4 * body


def _add_plane(
    scene: mujoco.MjvScene, middle: np.ndarray, frame: np.ndarray, half: float, rgba: Any
) -> None:
    geom = scene.geoms[scene.ngeom]
    size = np.array([half, half, 1.0])
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    mujoco.mjv_initGeom(geom, plane, size, middle, frame.ravel(), np.array(rgba, np.float32))
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # decoration casts no shadow
    scene.ngeom += 1


def _set_lights(stage: Stage, lookat: np.ndarray) -> None:
    """Puts a soft light at the camera and a sun with shadows above its shoulder."""
    scene, lens = stage.scene, stage.lens
    sun = np.stack([lens.right, lens.forward, UP], 1) @ _SUN
    sun /= np.linalg.norm(sun)
    scene.nlight = 2
    for light, is_sun in zip(scene.lights[:2], (False, True), strict=True):
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.texid, light.headlight, light.castshadow = -1, not is_sun, is_sun
        light.attenuation[:] = 1.0, 0.0, 0.0
        light.ambient[:] = 0.0 if is_sun else 0.45
        light.diffuse[:] = 0.45 if is_sun else 0.4
        light.specular[:] = 0.1 if is_sun else 0.0
        light.dir[:] = sun if is_sun else scene.camera[0].forward
        light.pos[:] = lookat - 3 * stage.body * sun if is_sun else scene.camera[0].pos
