# SPDX-License-Identifier: Apache-2.0
"""Training as a pure function: same seed same bits, stopped and continued, traced once."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, trainer
from jaxskills.compilation import jit
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.errors import UserError
from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.explore.starts import StartsConfig
from jaxskills.learn import gae, rollout
from jaxskills.learn.networks import NetworkConfig
from jaxskills.learn.ppo import PPOConfig
from jaxskills.trainer import TrainConfig, Trainer, TrainState

Update = Callable[[TrainState], tuple[TrainState, dict[str, jax.Array]]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return trainer.make(tiny.train_config(tmp_path_factory.mktemp("walker")))


@pytest.fixture(scope="module")
def update(made: Trainer, cache: Path) -> Update:
    return jit(made.update)


@pytest.fixture(scope="module")
def init(made: Trainer, cache: Path) -> Callable[[jax.Array], TrainState]:
    return jit(made.init)


def _run(update: Update, state: TrainState, updates: int) -> TrainState:
    for _ in range(updates):
        state, _ = update(state)
    return state


def test_the_same_seed_gives_the_same_bits(init, update: Update):
    ends = [_run(update, init(jax.random.key(3)), 6) for _ in range(2)]
    tiny.assert_same_bits(*ends)
    other = _run(update, init(jax.random.key(4)), 6)
    assert any(
        not np.array_equal(x, y)
        for x, y in zip(tiny.leaves(ends[0]), tiny.leaves(other), strict=True)
    )


def test_every_number_is_finite_and_something_is_learnt(init, update: Update):
    begin = init(jax.random.key(0))
    state, metrics = begin, {}
    for count in range(1, 6):
        state, metrics = update(state)
        assert int(state.updates) == count
    for leaf in tiny.leaves((state, metrics)):
        assert np.isfinite(leaf).all()
    for part in ("policy", "value"):
        before, after = (getattr(x.learner, part) for x in (begin, state))
        assert any(
            not np.array_equal(x, y)
            for x, y in zip(tiny.leaves(before), tiny.leaves(after), strict=True)
        )
    assert float(state.normalizer.count) == 8 + 5 * 8 * 4
    assert bool(state.starts.seen.any())


def test_update_is_traced_once_and_may_reuse_its_input(made: Trainer, init, update: Update):
    traces = []

    def counted(state: TrainState):
        traces.append(state)
        return made.update(state)

    compiled = jit(counted, donate=True)
    donated = _run(compiled, init(jax.random.key(0)), 5)
    assert len(traces) == 1
    tiny.assert_same_bits(donated, _run(update, init(jax.random.key(0)), 5))


def test_init_and_update_agree_on_shapes_and_types(made: Trainer):
    """So that updates can be scanned."""
    begin = jax.eval_shape(made.init, jax.random.key(0))
    after, _ = jax.eval_shape(made.update, begin)
    form = lambda tree: [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]  # noqa: E731
    assert form(after) == form(begin)


def test_saved_and_restored_runs_go_on_bit_for_bit(
    made: Trainer, init, update: Update, tmp_path: Path
):
    straight = _run(update, init(jax.random.key(0)), 20)
    half = _run(update, init(jax.random.key(0)), 10)
    checkpoint.save(tmp_path, half, 320)
    restored = checkpoint.restore(tmp_path, made)
    tiny.assert_same_bits(restored, half)
    tiny.assert_same_bits(_run(update, restored, 10), straight)


_CONTINUE = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_cpu_enable_async_dispatch", False)
from jaxskills import checkpoint, trainer
from jaxskills.compilation import jit
run, out = Path(sys.argv[1]), Path(sys.argv[2])
made = trainer.make(checkpoint.read_config(run))
state, update = checkpoint.restore(run, made), jit(made.update)
for _ in range(10):
    state, _ = update(state)
checkpoint.save(out, state, 640)
"""


def _continued_elsewhere(run: Path, out: Path, made: Trainer, **variables: str) -> TrainState:
    """Returns the state after ten updates in a process of its own."""
    source = str(Path(trainer.__file__).parents[1])
    subprocess.run(
        [sys.executable, "-c", _CONTINUE, str(run), str(out)],
        check=True,
        env=os.environ | {"PYTHONPATH": source} | variables,
    )
    return checkpoint.restore(out, made)


def test_a_fresh_process_goes_on_bit_for_bit(
    made: Trainer, init, update: Update, cache: Path, tmp_path: Path
):
    half = _run(update, init(jax.random.key(0)), 10)
    checkpoint.write_config(tmp_path, made.config)
    checkpoint.save(tmp_path, half, 320)
    shared = {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    continued = _continued_elsewhere(tmp_path, tmp_path / "out", made, **shared)
    tiny.assert_same_bits(continued, _run(update, half, 10))


def test_two_seeds_in_one_program_are_two_runs(made: Trainer, init, update: Update):
    seeds = [jax.random.key(seed) for seed in (0, 1)]
    alone = [_run(update, init(key), 2) for key in seeds]
    together = jit(jax.vmap(made.init))(jnp.stack(seeds))
    together = _run(jit(jax.vmap(made.update)), together, 2)
    for row, state in enumerate(alone):
        one = jax.tree.map(lambda x: x[row], together)  # noqa: B023
        for x, y in zip(tiny.leaves(one), tiny.leaves(state), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-3)


def test_starts_evolve(tmp_path: Path):
    """Elites are in the state, change with updates, and stand still in shape and in their place."""
    evolution = EvolutionConfig(enabled=True, elites=4)
    made = trainer.make(tiny.train_config(tmp_path, evolution=evolution))
    begin = jit(made.init)(jax.random.key(0))
    state = _run(jit(made.update), begin, 4)
    assert begin.elites is not None and state.elites is not None
    assert not np.array_equal(begin.elites.phase, state.elites.phase)
    assert float(state.elites.value.max()) > 0.0
    assert (state.elites.phase >= 0).all() and (state.elites.phase <= made.env.length).all()
    for leaf in tiny.leaves(state):
        assert np.isfinite(leaf).all()
    # Each elite is near the reference, since it was visited within the bounds.
    heights = np.asarray(state.elites.qpos)[..., 2]
    assert np.abs(heights - 0.5).max() < 0.3


def _transitions(made: Trainer, obs_size: int) -> rollout.Transition:
    """Returns four steps of eight environments, all numbers random, nothing ended."""
    rng = np.random.default_rng(0)
    normal = lambda *shape: jnp.asarray(rng.normal(size=(4, 8, *shape)), jnp.float32)  # noqa: E731
    return rollout.Transition(
        obs=normal(obs_size),
        next_obs=normal(obs_size),
        phase=30.0 * jnp.abs(normal()),
        state=None,
        action=normal(made.env.action_size),
        log_prob=normal(),
        rate=normal(),
        spike=normal(),
        dphase=jnp.exp(normal()),
        terminated=jnp.zeros((4, 8), bool),
        truncated=jnp.zeros((4, 8), bool),
        ended_by=jnp.zeros((4, 8), jnp.int32),
    )


def test_a_batch_holds_scaled_advantages_and_their_targets_row_by_row(made: Trainer, init):
    state = init(jax.random.key(0))
    steps = _transitions(made, state.current.obs.shape[-1])
    # One environment falls, one is cut off.
    steps = dataclasses.replace(
        steps,
        terminated=steps.terminated.at[1, 2].set(True),
        truncated=steps.truncated.at[2, 5].set(True),
    )
    batch = trainer.to_batch(made.config.ppo, made.networks, state.learner, state.normalizer, steps)
    assert batch.obs.shape[0] == batch.target.shape[0] == 32
    deviation = np.sqrt(np.asarray(state.normalizer.var)).clip(1e-3)
    seen = lambda obs: np.clip((obs - np.asarray(state.normalizer.mean)) / deviation, -5, 5)  # noqa: E731
    value = lambda obs: made.networks.value(state.learner.value, jnp.asarray(seen(obs)))  # noqa: E731
    advantage = np.zeros((4, 8))
    for env in range(8):
        column = lambda x: x[:, env]  # noqa: B023, E731
        advantage[:, env] = gae.advantages(
            column(steps.rate),
            column(steps.spike),
            column(steps.dphase),
            value(column(steps.obs)),
            value(column(steps.next_obs)),
            column(steps.terminated),
            column(steps.terminated | steps.truncated),
            made.config.ppo.discount,
            made.config.ppo.lambda_,
        )
        for t in range(4):
            row = t * 8 + env
            np.testing.assert_allclose(batch.obs[row], seen(steps.obs[t, env]), atol=1e-3)
            np.testing.assert_array_equal(batch.action[row], steps.action[t, env])
            np.testing.assert_array_equal(batch.log_prob[row], steps.log_prob[t, env])
            target = advantage[t, env] + value(steps.obs[t, env])
            np.testing.assert_allclose(batch.target[row], target, atol=1e-3)
    scaled = (advantage - advantage.mean()) / advantage.std()
    np.testing.assert_allclose(batch.advantage, scaled.ravel(), atol=2e-3)


def test_failures_are_counted_by_cause_and_phase(made: Trainer):
    names, steps = made.env.endings, _transitions(made, 3)
    cause = names.index("com_x") * jnp.ones((4, 8), jnp.int32)
    cause = cause.at[1, 2].set(names.index("diverged")).at[2, 5].set(names.index("time limit"))
    ended = jnp.zeros((4, 8), bool).at[0, 0].set(True).at[1, 2].set(True)
    # Twenty bins in a cycle of thirty frames; the third phase is in the second cycle.
    phase = jnp.zeros((4, 8)).at[0, 0].set(29.9).at[1, 2].set(1.6).at[2, 5].set(30.0 + 15.1)
    steps = dataclasses.replace(
        steps,
        terminated=ended,
        truncated=jnp.zeros((4, 8), bool).at[2, 5].set(True),
        ended_by=cause,
        phase=phase,
        rate=jnp.full((4, 8), 0.25),
        spike=jnp.full((4, 8), 0.5),
    )
    metrics = trainer.episode_metrics(made.env, steps)
    assert (float(metrics["steps"]), float(metrics["failures"])) == (32.0, 2.0)
    assert (float(metrics["diverged"]), float(metrics["reward"])) == (1.0, 0.75)
    table = np.asarray(metrics["endings"])
    assert table.shape == (len(names), trainer.PHASE_BINS)
    found = {(names[i], int(j)): table[i, j] for i, j in np.argwhere(table)}
    assert found == {("com_x", 19): 1.0, ("diverged", 1): 1.0}


_OUT_OF_RANGE = [
    ({"envs": 0}, "envs is 0: give 1 or more"),
    ({"horizon": -1}, "horizon is -1: give 1 or more"),
    ({"samples": 0}, "samples is 0: give 1 or more"),
    ({"seed": -1}, "seed is -1: give 0 to 4294967295"),
    ({"seed": 2**32}, "seed is 4294967296: give 0 to 4294967295"),
    ({"env": EnvConfig(substeps=0)}, "env.substeps is 0: give 1 to 100 (20 is 600 Hz)"),
    ({"env": EnvConfig(seconds=0.0)}, "env.seconds is 0.0: give 1/30 to 3600 s"),
    ({"env": EnvConfig(lead=99.0)}, "env.lead is 99.0: give -30 to 30 control frames"),
    ({"starts": StartsConfig(segments=0)}, "starts.segments is 0: give 1 or more"),
    ({"starts": StartsConfig(uniform=2.0)}, "starts.uniform is 2.0: give 0 to 1"),
    ({"ppo": PPOConfig(discount=1.0)}, "ppo.discount is 1.0: give 0 <= discount < 1"),
    ({"ppo": PPOConfig(minibatch=33)}, "ppo.minibatch is 33: give 1 to 32 (envs x horizon)"),
]


@pytest.mark.parametrize(("changes", "message"), _OUT_OF_RANGE)
def test_what_is_out_of_range_is_refused(changes: dict, message: str):
    config = TrainConfig(**({"envs": 8, "horizon": 4, "ppo": PPOConfig(minibatch=16)} | changes))
    with pytest.raises(UserError) as raised:
        trainer.validate(config)
    assert str(raised.value) == message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"envs": 0}, "envs is 0: give 1 or more"),
        ({"character": "robot"}, "unknown character 'robot': choose one of "),
        ({"clip": "none.npz"}, "clip 'none.npz' does not exist"),
        ({"backend": "tpu"}, "unknown backend 'tpu': choose one of cpu, mjx, warp"),
        ({"networks": NetworkConfig(noise=-1.0)}, "networks.noise is -1.0: give"),
        ({"bounds": BoundsConfig(root=-1.0)}, "bound root is -1.0: give positive sizes"),
        ({"bounds": BoundsConfig(channels={"tail": 1.0})}, "unknown bound 'tail': choose one of"),
    ],
)
def test_make_refuses_the_same_and_what_it_cannot_find(tmp_path: Path, changes: dict, message: str):
    with pytest.raises(UserError) as raised:
        trainer.make(tiny.train_config(tmp_path, **changes))
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_real_walk_gives_the_same_bits_and_goes_on_elsewhere(deepmimic: Path, tmp_path: Path):
    config = TrainConfig(
        backend="cpu", envs=64, networks=NetworkConfig((64, 32), (64, 32)), clip="walk"
    )
    made = trainer.make(config)
    init, update = jit(made.init), jit(made.update)
    first, second = (_run(update, init(jax.random.key(0)), 20) for _ in range(2))
    tiny.assert_same_bits(first, second)
    half = _run(update, init(jax.random.key(0)), 10)
    checkpoint.write_config(tmp_path, config)
    checkpoint.save(tmp_path, half, 10240)
    tiny.assert_same_bits(_continued_elsewhere(tmp_path, tmp_path / "out", made), first)
