"""Who may import whom, read off the source, and what an interpreter has loaded."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import saferl

PACKAGE = Path(saferl.__file__).parent


def module_name(path: Path) -> str:
    parts = ("saferl", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def resolve(name: str) -> str:
    """The module that a dotted name lies in: ``saferl.modules.project`` is in ``saferl.modules``."""
    while name not in MODULES:
        name = name.rpartition(".")[0]
    return name


def imports(name: str) -> set[str]:
    """Modules of saferl that a module imports, wherever in it."""
    path, found = MODULES[name], set()
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                base = ".".join(parts[: len(parts) + 1 - node.level] + ([base] if base else []))
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return {resolve(item) for item in found if item == "saferl" or item.startswith("saferl.")}


#: What a command line reaches: these alone may put concrete parts together.
COMMANDS = {"__main__", "catalog", "cli", "commands", "evaluate", "export"}
GRAPH = {name: imports(name) for name in MODULES}


def part(name: str) -> str:
    """``saferl.envs.intersection.cost`` is of the part ``envs``; ``saferl`` itself of ``""``."""
    return [*name.split("."), ""][1]


def foreign(name: str) -> set[str]:
    """What a module imports from other parts than its own."""
    return {target for target in GRAPH[name] if part(target) != part(name)}


def of(*parts: str) -> list[str]:
    return [name for name in MODULES if part(name) in parts]


def test_the_walk_sees_the_package():
    assert {"envs", "modules", "objectives", "trainer", "builders"} <= {part(n) for n in MODULES}
    assert "saferl.envs.intersection.geometry" in GRAPH["saferl.envs.intersection.cost"]
    assert "saferl.modules.projection" in GRAPH["saferl.envs.transforms.projector"]
    assert any(GRAPH[name] for name in of("objectives"))


@pytest.mark.parametrize("name", of("envs"))
def test_envs_import_nothing_else_and_transforms_only_modules(name):
    allowed = {"modules"} if name.startswith("saferl.envs.transforms") else set()
    assert {part(target) for target in foreign(name)} <= allowed | {"compiling"}


@pytest.mark.parametrize("name", of("modules"))
def test_modules_import_nothing_else(name):
    assert {part(target) for target in foreign(name)} <= {"compiling"}


@pytest.mark.parametrize("name", of("objectives"))
def test_objectives_import_only_modules(name):
    assert {part(target) for target in foreign(name)} <= {"modules"}


@pytest.mark.parametrize("name", of("trainer", "metrics", "checkpoint"))
def test_the_loop_imports_no_concrete_part(name):
    concrete = {"envs", "modules", "objectives", "agents", "builders", "experience", "hooks"}
    concrete |= COMMANDS
    reached, queue = set(), [name]
    while queue:
        new = GRAPH[queue.pop()] - reached
        reached |= new
        queue += new
    assert {part(target) for target in reached} & concrete == set()


def test_only_the_commands_import_the_builders():
    importers = {part(name) for name in MODULES if "saferl.builders" in GRAPH[name]}
    assert importers <= COMMANDS
    importers = {part(name) for name in MODULES if "saferl.agents" in GRAPH[name]}
    assert importers <= COMMANDS | {"builders"}


def test_there_is_no_cycle():
    settled: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in settled:
            for target in sorted(GRAPH[name] - {name}):
                visit(target, (*trail, name))
            settled.add(name)

    for name in MODULES:
        visit(name, ())


def fresh(code: str) -> str:
    """What a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.strip()


#: What the batched road and the parts do without; torch and torchrl import none of them either.
HEAVY = "{'highway_env', 'pygame', 'matplotlib', 'pandas'}"
LOADED = f"print(*sorted({HEAVY} & set(sys.modules)))"


def test_the_batched_road_and_the_parts_stand_alone():
    code = f"""
import sys
import saferl, saferl.envs, saferl.envs.transforms, saferl.modules, saferl.objectives
from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver
env = BatchedIntersection(Scenario(scenario="dense"), num_envs=2)
env.rollout(3, CautiousDriver())
env.reset()
{LOADED}
"""
    assert fresh(code) == ""


def test_highway_env_comes_with_the_first_use_of_what_is_built_on_it():
    named = "from saferl.envs.intersection import HighwayIntersection, IntersectionEnv"
    made = "import gymnasium; gymnasium.make('saferl/Intersection-LT-v0').reset(seed=0)"
    for use in (named, made):
        loaded = fresh(f"import sys, saferl.envs; {LOADED}; {use}; {LOADED}")
        assert loaded.split() == ["highway_env", "matplotlib", "pandas", "pygame"], use


def test_the_packages_names_are_there_and_no_others():
    package = importlib.import_module("saferl.envs.intersection")
    assert set(package.__all__) <= set(dir(package))
    assert all(hasattr(package, name) for name in package.__all__)
    assert not hasattr(package, "Roundabout")
