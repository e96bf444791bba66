"""A bar for whoever watches, and a line now and then for whoever reads it later."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any, TextIO

from tqdm import tqdm


class _Lines:
    """A stream on which each state of a bar is a line of its own; one that takes no more ends nobody's run."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> None:
        if line := text.strip():
            with suppress(OSError):
                self.stream.write(f"{line}\n")

    def flush(self) -> None:
        with suppress(OSError):
            self.stream.flush()


def bar(**options: Any) -> tqdm:
    """A progress bar on standard error; where that is no terminal, a line each minute.

    Args:
        **options: of tqdm.
    """
    if sys.stderr.isatty():
        return tqdm(dynamic_ncols=True, mininterval=1.0, **options)
    lines: Any = _Lines(sys.stderr)
    return tqdm(file=lines, ncols=110, mininterval=60.0, maxinterval=60.0, **options)
