# SPDX-License-Identifier: Apache-2.0
"""MJX's own promises: what it refuses, that it ends on few cores, and a whole humanoid."""

import numpy as np
import pytest
from physics_cases import PLAIN, ROWS, c_loop, flat, make_case, run_alone, toy

from jaxskills import character, physics
from jaxskills.errors import UserError

pytestmark = pytest.mark.timeout(300)


def test_mjx_names_what_it_cannot_vary():
    engine = physics.make("mjx", 1, num_envs=1)
    masked = toy()
    masked.geom_contype[1] = 1
    with pytest.raises(UserError, match="geom_contype"):
        engine.load([toy(), masked])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_shipped_humanoid_in_mjx_follows_c():
    model = character.load("humanoid34").model
    case = make_case("mjx", [model])
    qpos = np.tile(model.qpos0, (ROWS, 1)).astype(np.float32)
    qpos[:, 2] += np.linspace(0.0, 0.05, ROWS)
    qvel = np.zeros((ROWS, model.nv), np.float32)
    ctrl = np.zeros((5, ROWS, model.nu), np.float32)
    state = case.start(qpos, qvel, PLAIN)
    for control in ctrl:
        state = case.step(case.loaded, PLAIN, state, control)
    expected = [c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)]
    assert np.abs(flat(state) - np.stack(expected)).max() < 0.02


CROWD = """
import jax
import numpy as np
import physics_cases as cases
from jaxskills import physics
from jaxskills.compilation import jit
qpos, qvel, ctrl = cases.inputs(64)
engine = physics.make("mjx", 2, num_envs=64)
loaded = engine.load([cases.toy()])
variant = np.zeros(64, np.int32)
state = jax.vmap(engine.init, (None, 0, 0, 0))(loaded, variant, qpos, qvel)
step = jit(jax.vmap(engine.step, (None, 0, 0, 0)))
for _ in range(30):
    state = step(loaded, variant, state, ctrl[0])
print(int(state.diverged.sum()))
"""


def test_mjx_with_many_environments_on_two_cores_ends(tmp_path):
    """XLA's thread pool of two threads would wait for itself for ever."""
    assert run_alone(CROWD, tmp_path, NPROC="2").strip() == "0"


LATE = """
import jax
import pytest
from jaxskills import physics
from jaxskills.errors import UserError
jax.devices()
with pytest.raises(UserError, match="NPROC=8"):
    physics.make("mjx", 2, num_envs=64)
"""


def test_mjx_refuses_a_pool_that_is_too_small(tmp_path):
    """The pool cannot grow once jax runs: an error is better than a program that hangs."""
    run_alone(LATE, tmp_path, NPROC="2")
