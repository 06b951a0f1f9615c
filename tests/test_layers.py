# SPDX-License-Identifier: Apache-2.0
"""The architecture, enforced: who may import whom, how long things may be, what is documented."""

import ast
import importlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

import jaxskills

# A module imports only from modules above it. A folder's `__init__` is its last line.
ORDER: Sequence[str] = """
errors paths compilation

rotation pose
clip.data clip.roles clip.deepmimic clip.bvh clip.keyframes clip
character
retarget.hinges retarget.posed retarget.mapping retarget
kinematics terrain ground motion flight objects levels variation trace
check.measures check.repairs check.faults check

physics.quiet physics.ffi physics.base physics.cpu physics.box_floor physics.explicit
physics.mjx physics.servo physics
env.observe env.bounds env.bounds_file env.rewards env.tracking env.style env.gram
env.holds env.variants env.measure env.task env.conditions env.obstacles env.push env.strike
env.worlds env.core env
learn.networks learn.normalize learn.windows learn.autoencoder learn.gae learn.ppo learn.rollout
learn
explore.starts explore.evolution explore.adaptive explore.refine explore.fitness explore.elites
explore.parameterization explore.marginal explore.sampling explore.curriculum explore.lean
explore.family
explore.episodes explore

trainer recipes families checkpoint runs warm_start evaluate perform evaluate_family controller
style_measures judge train
render.opengl render.stage render.take render.video render.several render.strip render
plot.sheet plot.lines plot.states plot.training plot.starts plot.family plot
task_values playback playback_family provenance

progress arguments commands cli __main__
""".split()

# A package of an extra, and what is slow and seldom needed: imported when used.
IN_FUNCTIONS = {"pybvh", "jaxskills.physics.mjx", "jaxskills.commands", "jaxskills.recipes"}

MAX_LINES = 400
MAX_FUNCTION_LINES = 60

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCE = REPOSITORY / "src" / "jaxskills"

Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = Function | ast.ClassDef


def _module_name(path: Path) -> str:
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {_module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def _imports(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Full names of what is imported, each with its line: `jaxskills.errors.UserError`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


def _own_module(imported: str) -> str | None:
    """`jaxskills.errors.UserError` -> `errors`; another package -> None."""
    if imported.split(".")[0] != "jaxskills":
        return None
    name = imported.partition(".")[2]
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name


def _functions(tree: ast.AST) -> Iterator[Function]:
    yield from (node for node in ast.walk(tree) if isinstance(node, Function))


def _own_lines(function: Function) -> int:
    """Lines of the body without its docstring and without the functions defined in it."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    inner = [node for part in body for node in ast.walk(part) if isinstance(node, Function)]
    lines = {line for node in body for line in _span(node)}
    return len(lines - {line for node in inner for line in _span(node)})


def _span(node: ast.stmt) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def _public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, Documented]]:
    """Public functions and classes, and the public methods of those classes."""
    for node in body:
        if isinstance(node, Documented) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from _public(node.body, f"{node.name}.")


def test_every_module_has_its_place():
    assert set(MODULES) - {""} == set(ORDER)
    assert len(ORDER) == len(set(ORDER))


@pytest.mark.parametrize("name", [name for name in MODULES if name])
def test_imports_only_from_above(name: str):
    above = ORDER[: ORDER.index(name)]
    for imported, line in _imports(TREES[name]):
        own = _own_module(imported)
        assert own is None or own in above, f"{name}:{line} imports {imported} from below"


@pytest.mark.parametrize("name", MODULES)
def test_imports_stand_at_the_top(name: str):
    for function in _functions(TREES[name]):
        for imported, line in _imports(function):
            allowed = any(f"{imported}.".startswith(f"{one}.") for one in IN_FUNCTIONS)
            assert allowed, f"{name}:{line} imports {imported} inside {function.name}"


@pytest.mark.parametrize("name", MODULES)
def test_fits_on_a_screen(name: str):
    assert len(MODULES[name].read_text().splitlines()) <= MAX_LINES
    for function in _functions(TREES[name]):
        lines = _own_lines(function)
        assert lines <= MAX_FUNCTION_LINES, f"{name}.{function.name} has {lines} lines"


@pytest.mark.parametrize("name", MODULES)
def test_is_documented(name: str):
    text = MODULES[name].read_text()
    if not text and name in {"env", "learn", "explore"}:
        return  # a bare folder
    assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n")
    assert ast.get_docstring(TREES[name]), f"{name} does not say what it is"
    missing = [path for path, node in _public(TREES[name].body) if not ast.get_docstring(node)]
    assert not missing


@pytest.mark.parametrize("name", [name for name in MODULES if name != "__main__"])
def test_public_names_resolve(name: str):
    module = importlib.import_module(f"jaxskills.{name}".rstrip("."))
    public = getattr(module, "__all__", [])
    assert len(public) == len(set(public))
    missing = [one for one in public if not hasattr(module, one)]
    assert not missing


def test_no_path_of_one_machine():
    machine = re.compile(r"(?<![\w.])(/(?:work|home|root|Users|tmp|opt|mnt)/|\.\./shared)")
    folders = ("src", "tests", "experiments", "benchmarks", "data", ".ci")
    files = [path for folder in folders for path in sorted((REPOSITORY / folder).rglob("*"))]
    texts = [p for p in files if p.suffix in {".py", ".md", ".toml", ".xml", ".json", ".ipynb", ""}]
    for path in [*texts, *REPOSITORY.glob("*.md"), REPOSITORY / "pyproject.toml"]:
        if path.is_file():
            found = machine.search(path.read_text())
            assert not found, f"{path.relative_to(REPOSITORY)} names {found[0] if found else ''}"


def test_the_package_tested_is_this_one():
    """A stale install would make every other test meaningless."""
    installed = Path(jaxskills.__file__).parent
    for name, path in MODULES.items():
        assert (installed / path.relative_to(SOURCE)).read_text() == path.read_text(), name
