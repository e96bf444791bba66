"""What a bar leaves in a file."""

from __future__ import annotations

import errno
import io

import pytest

from saferl.evaluation.progress import bar


def test_a_log_gets_a_line_at_the_start_and_at_the_end(capsys: pytest.CaptureFixture):
    with bar(total=1000, desc="train", unit="frame") as shown:
        for _ in range(1000):
            shown.update()
    text = capsys.readouterr().err
    first, last = text.splitlines()
    assert "\r" not in text and first.startswith("train:   0%") and "0/1000" in first
    assert last.startswith("train: 100%") and "1000/1000" in last


def test_a_log_without_room_ends_nothing(monkeypatch: pytest.MonkeyPatch):
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("sys.stderr", Full())
    with bar(total=1000, desc="train") as shown:
        for _ in range(1000):
            shown.update()
    assert shown.n == 1000
