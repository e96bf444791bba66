"""Command lines as they are typed, and as Hydra reads them."""

from __future__ import annotations

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from saferl.cli.arguments import readable

NAMES = (
    "Läufe", "run (1)", "algo=rsac,seed=0", "50%", "a{b}", "it's", "a\\b", "a\\'b", "ends\\", "tab\tx", "x:y", "a#b",
    "*?[]", "~/x", "$HOME", "  lead", "true", "007", ".5", "1e3", "nan", "''q''x", 'a"b', "日本", "plain/../path-1.x",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_path_is_read_as_it_is_written(name: str):
    (setting,) = readable([f"resume={name}"])
    (override,) = OverridesParser.create().parse_overrides([setting])
    value = override.value()
    assert getattr(value, "text", value) == name
    assert "resume=null" in readable(["resume=null"])


def test_a_sweep_over_paths_parts_them_at_commas(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert readable(["-m", "resume=r (1),r2"])[0] == "resume='r (1)',r2"
    (tmp_path / "a,b").mkdir()
    assert readable(["-m", "resume=a,b"])[0] == "resume='a,b'"
    assert readable(["-m", "out=a,c"])[0] == "out='a,c'"
    assert readable(["-m", "init=glob(*)"])[0] == "init=glob(*)"
    assert readable(["-m", f"init={'a' * 300},b"])[0].startswith("init=aaa")


def test_flags_stand_anywhere():
    assert readable(["seed=0", "-m", "--config-dir", "my conf", "algo=sac", "--info"]) == [
        "seed=0",
        "algo=sac",
        "hydra.job.config.override_dirname.exclude_keys=['seed','algo']",
        "-m",
        "--config-dir",
        "my conf",
        "--info",
    ]
    assert readable(["seed=0,1", "-m"])[1].endswith("exclude_keys=[]")
    assert readable(["a=(", "-m"]) == ["a=(", "-m"]  # the composition says what is wrong
