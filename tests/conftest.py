# SPDX-License-Identifier: Apache-2.0
"""What every test shares: a home folder and compiled code for the whole run, the real clips."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
import tiny

from jaxskills import physics
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.motion import Motion
from jaxskills.paths import deepmimic_dirs

# Tests compile more than they run: all take 14 minutes instead of 21 where LLVM does not optimise.
# What they start inherits it. Before jax uses a device, as what follows.
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "")
    + " --xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)

# MJX under vmap can wait for ever on two cores otherwise.
physics.configure_cpu()


@pytest.fixture(scope="session", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home folder of its own for the whole session: no test reads or writes the user's."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(folder))
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        patch.setenv("MPLBACKEND", "agg")
        yield folder


@pytest.fixture(scope="session", autouse=True)
def compiled_code(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one test has compiled the next ones find, as runs of the command line do.

    With pytest-xdist the workers share it: their folders are beside each other.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))


@pytest.fixture(scope="session")
def deepmimic() -> Path:
    """The folder of the DeepMimic motion files; tests that need it skip without the extra."""
    try:
        return deepmimic_dirs()[-1]
    except UserError as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of compiled code, also quickly compiled, for who compiles the same again."""
    with tiny.compilation_cache(tmp_path_factory.mktemp("cache")) as folder:
        yield folder


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    """The walker of `tiny`, if a module has no other character."""
    return tiny.load_character(tmp_path_factory.mktemp("character"))


@pytest.fixture(scope="module")
def walk(who: Character) -> Motion:
    """Its walk, a loop."""
    return tiny.make_motion(who, tiny.walking(), loop=True)
