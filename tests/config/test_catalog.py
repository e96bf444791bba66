"""The catalog lists every option with one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from saferl.config.catalog import GROUPS, main, options
from saferl.config.locate import config_dir

ROOT = Path(config_dir())


def test_every_group_that_is_chosen_from_is_listed():
    groups = {path.name for path in ROOT.iterdir() if path.is_dir()}
    assert set(GROUPS) == groups - {"hydra", "recipe"}


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_has_one_line(group: str):
    found = options(group)
    assert set(found) == {path.stem for path in (ROOT / group).glob("*.yaml")} and found
    for name, line in found.items():
        assert 5 < len(line) <= 110 and line[-1] not in ",;", f"{group}={name}: {line!r}"


def test_prints_all_or_what_is_asked_for(capsys):
    main(["task", "risk"])
    out = capsys.readouterr().out
    assert "task=\n" in out and "risk=\n" in out and "algo=" not in out
    assert "  gs        Go straight.\n" in out
    command = [sys.executable, "-m", "saferl.catalog"]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert all(f"{group}=\n" in out for group in GROUPS)
    with pytest.raises(SystemExit, match="error: group must be one of algo, .*, got 'alog'"):
        main(["alog"])


def test_lists_a_users_own_folder_too(capsys, tmp_path: Path):
    (tmp_path / "algo").mkdir()
    (tmp_path / "algo/mine.yaml").write_text("# @package _global_\n# Better than theirs.\n")
    main(["algo", "--config-dir", str(tmp_path)])
    out = capsys.readouterr().out
    assert "Better than theirs." in out and "  arsac " in out
    with pytest.raises(SystemExit, match="error: --config-dir: no such folder: nowhere"):
        main(["algo", "--config-dir", "nowhere"])
