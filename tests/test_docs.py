"""Every snippet and command of README.md and docs/ is run in the order in which it stands there, with small budgets.

Of trainings those run that a page reads later, or tries its own files by; all others are composed, checked and built.
"""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from hydra.errors import HydraException
from omegaconf import DictConfig
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_agent, complete
from saferl.cli.arguments import readable
from saferl.cli.tune import main as tune
from saferl.config import schema
from saferl.config.catalog import main as catalog
from saferl.config.check import check
from saferl.evaluation.compare import main as summary
from saferl.report.command import main as report

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Languages that are run, and those that only show: a table that was printed, what Sphinx reads.
RUN, SHOWN = {"python", "yaml", "bash"}, {"text", "{toctree}", "{eval-rst}", "{include}"}
#: Behind the language of a block that cannot be run, with the reason.
NOT_RUN = "not run: "
#: What stands for all the jobs that a preset starts.
FEWER = {
    "experiment=paper_comparison": ("algo=sac", "seed=3"),
    "experiment=paper_ablation": ("algo=sac", "seed=3"),
    "experiment=cart_profile": ("algo=ppo_lag", "lagrange=fixed", "lagrange.multiplier.init=1.0"),
    "experiment=multiplier_profile": ("lagrange=fixed", "lagrange.multiplier.init=1.0"),
}


#: What stands for folders of this repository, for whose runs drivers would play for minutes.
OURS = {"docs/results/numbers": "paper"}

#: Commands that print a table.
TABLES = {"catalog": catalog, "summary": summary, "report": report}


class Built:
    """A training that is over before it begins."""

    def __init__(self, cfg: DictConfig, run: Path):
        complete(cfg.task)
        check(cfg)
        build_agent(cfg)

    def train(self, *args: object) -> None: ...

    resume = close = train


class Block(NamedTuple):
    """A fenced block: its language, what else its first line says, its text."""

    language: str
    note: str
    text: str


def blocks(page: Path) -> list[Block]:
    found = re.findall(r"^```(\S*) ?(.*)\n([\s\S]*?)^```$", page.read_text(), re.MULTILINE)
    return [Block(*each) for each in found]


def commands(text: str) -> list[str]:
    """The commands of a block of bash, without comments."""
    lines = (re.sub(r"(^|\s)#.*", "", line).strip() for line in text.splitlines())
    return [line for line in lines if line]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_is_run_or_says_why_not(page: Path):
    assert page.read_text().count("```") == 2 * len(blocks(page))
    for language, note, text in blocks(page):
        assert language in RUN | SHOWN, f"```{language} is neither run nor shown"
        assert language in RUN or "-m saferl" not in text
        if note and language in RUN:
            assert note.startswith(NOT_RUN) and len(note) > len(NOT_RUN) + 10, note


def test_few_blocks_are_not_run():
    every = [block for page in PAGES for block in blocks(page) if block.language in RUN]
    assert sum(bool(block.note) for block in every) <= 2 and len(every) > 50


@pytest.fixture
def saferl(command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs a command of ours, as small as it can be; the files of a page lie in the folder beside it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    before = set(sys.modules)

    def run(module: str, *given: str, later: str | None = None) -> None:
        arguments = [str(ROOT / a) if a.startswith("examples/") else a for a in given]
        arguments = [OURS.get(argument, argument) for argument in arguments]
        _, _, door = module.rpartition("saferl.")
        if door in TABLES:
            TABLES[door](arguments)
            return
        if door == "tune":  # composed, checked and built, each end of each range; no trial
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("saferl.cli.search.Search.run", lambda self, trials, seeds: None)
                tune(arguments)
            return
        assert module == "saferl" or door in ("evaluate", "export"), module
        door, config = ("train", "config") if module == "saferl" else (door, door)
        if "--help" in arguments:
            with pytest.raises(SystemExit) as left:
                command(door, config, *arguments)
            assert not left.value.code
            return
        if not any(argument.startswith(("-", "hydra/")) for argument in arguments):
            schema.check(compose(*readable(arguments), config=config))  # as it stands there
        with pytest.MonkeyPatch.context() as patch:
            if door == "train" and not is_read(arguments, later):
                patch.setattr("saferl.cli.train.build_trainer", Built)
                patch.setattr("saferl.cli.train.closing_test", lambda cfg, run: None)
            command(door, config, *smaller(door, arguments))

    yield run
    for module in set(sys.modules) - before:
        if module.startswith("my_"):
            del sys.modules[module]


def is_read(arguments: list[str], later: str | None) -> bool:
    """Whether the rest of a page names a training's folder; None: everything is read."""
    folders = [a.removeprefix("out=") for a in arguments if a.startswith("out=")]
    folders = folders or ["multirun" if "-m" in arguments else "runs/"]
    begun = any(a.startswith("resume=") or a in FEWER for a in arguments)
    return later is None or begun or folders[0] in later


def smaller(door: str, arguments: list[str]) -> list[str]:
    """A command line with a small budget, one seed, the ends of each choice, in this process; the road gives way to other
    tasks and backends."""
    if door == "export":  # attention and a projector take long to write down as a graph
        return [re.sub("^pretrained=arsac$", "pretrained=sac_lag", a) for a in arguments]
    if any(argument.startswith("resume=") for argument in arguments):
        return [re.sub(r"^frames=.*", "frames=32", argument) for argument in arguments]
    arguments = [re.sub(r"^(seed=\d+),.*", r"\1", argument) for argument in arguments]
    arguments = [re.sub(r"^([\w.]+=\w+),.*,(\w+)$", r"\1,\2", argument) for argument in arguments]
    names = {argument.partition("=")[0] for argument in arguments}
    fewer = next((FEWER[a] for a in arguments if a in FEWER), ())
    arguments += [each for each in fewer if each.partition("=")[0] not in names]
    small = (
        *EMPTY,
        "task.duration=2",
        *(SMALL if door == "train" else ("episodes=2", "draw=none")),
    )
    other = any(re.match(r"(task|experiment)=(gym|cart|tank)", a) for a in arguments)
    kept = {"env", "task.vehicles", "task.duration"} if other else {"env"} & names
    small = tuple(a for a in small if a.partition("=")[0] not in kept)
    replaced = {a.partition("=")[0] for a in small}
    arguments = [a for a in arguments if not a.startswith(("hydra/launcher", "hydra.launcher."))]
    return [*(a for a in arguments if a.partition("=")[0] not in replaced), *small]


def extras() -> set[str]:
    return set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])  # fmt: skip


def check_script(path: str, *arguments: str) -> None:
    """A script is there, and so are the flags that it is given; others run it."""
    source = (ROOT / path).read_text()
    sources = source + "".join(
        (ROOT / "benchmarks" / f"{module}.py").read_text()
        for module in re.findall(r"^from (\w+) import", source, re.MULTILINE)
        if (ROOT / "benchmarks" / f"{module}.py").is_file()
    )
    for flag in (argument for argument in arguments if argument.startswith("--")):
        assert f'"{flag}"' in sources, f"{path} has no {flag}"


def play(line: str, saferl: Callable[..., None], later: str | None = None) -> None:
    """Run one command of a page, or check that what it names is there.

    Args:
        line: the command.
        saferl: runs those of ours.
        later: the rest of the page, which tells what must be trained; None: everything.
    """
    words = shlex.split(line)
    while re.fullmatch(r"[A-Z_]+=\w+", words[0]):
        del words[0]
    match words:
        case ["python" | ".venv/bin/python", "-m", module, *arguments]:
            saferl(module, *arguments, later=later)
        case ["python", script, *arguments]:
            check_script(script, *arguments)
        case ["make", target, *_]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        case ["pip", "install", package]:
            assert re.fullmatch(r"saferl\[(\w+)\]", package)[1] in extras()  # pyright: ignore
        case _:
            raise AssertionError(f"nothing runs {line!r}; say so behind the block's language")


def write(language: str, text: str, folder: Path) -> bool:
    """Write a block that is a file, as its first comment says, into a page's folder."""
    path = re.search(r"^# (my_\S+\.(?:py|yaml))$", text, re.MULTILINE)
    if path:
        file = folder / path[1]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return bool(path)


def run_page(page: Path, saferl: Callable[..., None], folder: Path) -> None:
    names: dict = {"__name__": "page"}
    todo = [b for b in blocks(page) if b.language in RUN and not b.note]
    # Files first, as a command may name one that is shown after it.
    own = [b for b in todo if write(b.language, b.text, folder)]
    todo = [b for b in todo if b not in own]
    for number, (language, _, text) in enumerate(todo):
        if language == "python":
            exec(compile(text, name(page), "exec"), names)
        elif language == "bash":
            lines, rest = commands(text), " ".join(b.text for b in todo[number + 1 :])
            for index, line in enumerate(lines, 1):
                later = None if own else " ".join([*lines[index:], rest])
                play(line, saferl, later)
        else:  # a file of ours that is quoted
            assert any(path.read_text() == text for path in (ROOT / "conf").rglob("*.yaml")), text


@pytest.mark.parametrize("page", [p for p in PAGES if {b.language for b in blocks(p)} & RUN], ids=name)  # fmt: skip
def test_page(page: Path, saferl, tmp_path: Path):
    run_page(page, saferl, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_scripts_that_a_page_names(page: Path):
    for line in re.findall(r"`python ((?:benchmarks|examples)/[^`]+)`", page.read_text()):
        check_script(*shlex.split(" ".join(line.split())))


def test_a_block_that_nothing_runs_is_found(saferl):
    for line in ("python -m pytest", "rm -rf runs", "pip install torch"):
        with pytest.raises((AssertionError, TypeError)):
            play(line, saferl)
    with pytest.raises(AssertionError, match=r"oracle.py has no --speed"):
        play("python benchmarks/oracle.py --speed 3", saferl)
    with pytest.raises(HydraException, match="gama"):
        play("python -m saferl gama=0.9", saferl, later="")
    with pytest.raises(SystemExit, match="needs lagrange, got lagrange=none"):
        play("python -m saferl algo=arsac lagrange=none", saferl, later="")


def test_every_page_is_linked_from_the_site():
    """Sphinx warns of a page in no table of contents; README must reach the doors."""
    readme = (ROOT / "README.md").read_text()
    for target in re.findall(r"\]\((docs/[^)#]+)\)", readme):
        assert (ROOT / target).is_file(), target
    assert len(readme.splitlines()) < 80
