"""Help says of every setting what its file says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf
from small import compose

from saferl.config.comments import comments
from saferl.config.flat import flat
from saferl.config.locate import config_dir

ROOT = Path(config_dir())
DOORS = {"train": "config", "evaluate": "evaluate", "export": "export"}
#: What a user composes; experiments and recipes change settings that are explained where they are.
EXPLAINED = [
    path
    for path in sorted(ROOT.rglob("*.yaml"))
    if path.relative_to(ROOT).parts[0] not in ("algo", "experiment", "hydra", "recipe", "export.yaml")
]  # fmt: skip


@pytest.fixture
def help_of(command, capsys, monkeypatch: pytest.MonkeyPatch):
    """What a door prints of its settings, on a terminal of so many columns."""

    def run(door: str, *arguments: str, columns: int = 1000) -> str:
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit) as left:
            command(door, DOORS[door], *arguments, "--help")
        assert not left.value.code
        return capsys.readouterr().out

    return run


def shown(text: str) -> Any:
    """The settings of a help text."""
    return yaml.load(text.partition("== Settings")[2].partition("\n")[2], yaml.SafeLoader)


@pytest.mark.parametrize("path", EXPLAINED, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_setting_has_a_comment(path: Path):
    """But for classes, and for what only passes another setting on."""
    own = {k: v for k, v in yaml.safe_load(path.read_text()).items() if k not in ("defaults", "hydra")}  # fmt: skip
    silent = [
        name
        for name, value in flat(own).items()
        if not name.rpartition(".")[2].startswith("_")
        and not re.fullmatch(r"\$\{[\w.]+\}", str(value))
        and value != {}
    ]
    assert set(silent) <= set(comments(path.read_text()))


@pytest.mark.parametrize("door", ["train", "evaluate"])
def test_no_comment_of_the_main_files_is_lost(door: str, help_of):
    """Collected without a parser: all that stands behind a #, from the first setting to Hydra's own."""
    text = (ROOT / f"{DOORS[door]}.yaml").read_text()
    settings = re.search(r"\n\n((?!defaults).*?)\nhydra:", text, re.DOTALL)
    assert settings
    found = re.findall(r"(?:^|\s)# (.+)", settings[1])
    assert len(found) > 10
    told = " ".join(help_of(door).split())
    assert [line for line in found if line not in told] == []


@pytest.mark.parametrize(
    ("door", "arguments", "columns"),
    [
        ("train", (), 80),
        ("train", ("algo=cpo", "task=mixed", "experiment=paper", "gamma=0.5"), 1000),
        ("evaluate", ("task=rt", "env=highway"), 1000),
        ("export", ("out=folder",), 80),
    ],
)
def test_help_shows_the_settings_as_they_are_composed(door: str, arguments, columns: int, help_of):
    composed = compose(*arguments, config=DOORS[door])
    text = help_of(door, *arguments, columns=columns)
    assert flat(shown(text)) == flat(OmegaConf.to_container(composed, resolve=False))


def test_comments_stand_where_they_belong(help_of):
    text = help_of("train", "task=mixed", "encoder=mlp")
    for line in (
        r"env: +# batched: All environments in one set of tensors\.",
        r"task: +# mixed: Left, straight or right, drawn at each reset\.",
        r"  duration: 25\.0 +# seconds",
        r"encoder: +# mlp: Layers on the whole scene or observation as one vector\.",
        r"learning: +# off_policy: .*",
        r"    actor: \[0\.0003, 1\.0e-05\] +# of the policy",
        r"risk_limit: 0\.05 +# d_thres, on the discounted cost .*",
    ):
        assert re.search(rf"^{line}$", text, re.MULTILINE), line
    assert "recipe" not in text and "_schema" not in text
    text = help_of("evaluate")
    assert re.search(r"^# Of random, blind .*\nenv: +# batched: All .*\.$", text, re.MULTILINE)


def test_long_comments_are_wrapped(help_of):
    lines = help_of("train", columns=80).partition("== Settings")[2].splitlines()
    assert max(len(line) for line in lines if "${" not in line and "_target_" not in line) <= 80


def test_a_users_own_files_are_explained_too(help_of, tmp_path: Path):
    (tmp_path / "my/encoder").mkdir(parents=True)
    (tmp_path / "my/encoder/own.yaml").write_text(
        "# Ours.\ndefaults: [mlp]\nwidth: 7 # units: 'seven'\n"
    )
    text = help_of("train", "--config-dir", "my", "encoder=own")
    assert re.search(r"^encoder: +# own: Ours\.$", text, re.MULTILINE)
    assert re.search(r"^  width: 7 +# units: 'seven'$", text, re.MULTILINE)
    assert "encoder: mlp, mmam, own, set\n" in text


@pytest.mark.parametrize("door", DOORS)
def test_help_needs_no_torch(door: str):
    code = f"""
import sys
from saferl.cli.launch import launch
sys.argv = ["saferl", "--help"]
try:
    launch("{door}", "{DOORS[door]}")
except SystemExit:
    pass
print(*sorted({{"torch", "torchrl", "matplotlib", "scipy"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "== Settings" in done.stdout and done.stdout.splitlines()[-1] == ""
