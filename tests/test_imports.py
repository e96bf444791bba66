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


GRAPH = {name: imports(name) for name in MODULES}

#: What each room may import besides itself; doors stand at the top and open ``cli`` and nothing behind it, or one room.
ROOMS = {
    "modules": set(),
    "envs": {"modules"},  # its transforms alone, see below
    "objectives": {"modules"},
    "checkpoint": {"config"},
    "evaluation": {"config", "checkpoint", "envs", "modules"},
    "report": {"config", "algorithms", "checkpoint", "evaluation", "envs"},
    "training": {"config", "checkpoint", "evaluation", "envs", "objectives", "modules"},
    "config": {"envs"},
    "algorithms": {"config", "training", "checkpoint", "envs", "objectives", "modules"},
    "deploy": {"config", "algorithms", "checkpoint", "evaluation", "envs", "modules"},
    "cli": {"config", "algorithms", "training", "evaluation", "checkpoint", "envs", "deploy"},
}
DOORS = {"__main__": "cli", "evaluate": "cli", "export": "cli", "summary": "evaluation"}
DOORS |= {"catalog": "config", "tune": "cli"}


def part(name: str) -> str:
    """``saferl.envs.intersection.collision_cost`` is of the part ``envs``; ``saferl`` itself of ``""``."""
    return [*name.split("."), ""][1]


def foreign(name: str) -> set[str]:
    """Other parts than its own from which a module imports."""
    return {part(target) for target in GRAPH[name]} - {part(name)}


def test_the_walk_sees_the_package():
    assert {part(name) for name in MODULES} == {"", *ROOMS, *DOORS}
    assert "saferl.envs.intersection.geometry" in GRAPH["saferl.envs.intersection.collision_cost"]
    assert "saferl.modules.projection" in GRAPH["saferl.envs.transforms.projector"]


@pytest.mark.parametrize("name", [name for name in MODULES if part(name) in ROOMS])
def test_a_room_imports_only_from_those_below(name):
    assert foreign(name) <= ROOMS[part(name)]


ENVIRONMENTS = [
    name
    for name in MODULES
    if part(name) == "envs" and not name.startswith("saferl.envs.transforms")
]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_environment_takes_nothing_of_modules_but_compiling(name):
    assert {t for t in GRAPH[name] if part(t) != "envs"} <= {"saferl.modules.compiled"}


@pytest.mark.parametrize("door", DOORS)
def test_at_the_top_stand_doors_alone(door):
    assert foreign(f"saferl.{door}") == {DOORS[door]}
    assert len(MODULES[f"saferl.{door}"].read_text().splitlines()) < 12


def test_the_loop_imports_no_concrete_part():
    reached, queue = set(), ["saferl.training.trainer"]
    while queue:
        new = GRAPH[queue.pop()] - reached
        reached |= new
        queue += new
    assert not {part(target) for target in reached} & {"envs", "objectives", "algorithms", "cli"}
    assert {name for name in reached if part(name) == "modules"} <= {"saferl.modules.compiled"}


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
env = BatchedIntersection(Scenario(scenario="dense"), num_envs=2, seed=0)
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


SCRIPTS = sorted((PACKAGE.parent / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_script_takes_of_saferl_is_there(script: Path):
    """Scripts run in the slow tests alone; what they import at their top can be looked up at once."""
    for node in ast.parse(script.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("saferl"):
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"
