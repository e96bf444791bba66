"""One process at a time works on a run."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

_LOCK, _HOLDER = ".lock", ".holder"


@contextmanager
def alone(run: Path, option: str) -> Iterator[None]:
    """Keep other processes out of a run's folder while this one works in it.

    The operating system lets go of the lock when the process ends, however it ends. On a shared file system it
    holds between machines as far as that system has locks (``flock``).

    Args:
        run: the folder.
        option: what errors call it.

    Raises:
        ValueError: another process works on the run; says which.
    """
    lock, holder = FileLock(run / _LOCK), run / _HOLDER
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{option}: {_who(run)} works on {run}; wait until it ends, or stop it."
        ) from None
    try:
        holder.unlink(missing_ok=True)  # of a process that was killed
        since = datetime.now().isoformat(" ", "seconds")
        holder.write_text(f"process {os.getpid()} on {socket.gethostname()} since {since}\n")
        yield
    finally:
        with suppress(OSError):  # the folder may be gone
            holder.unlink(missing_ok=True)
            if [path.name for path in run.iterdir()] == [_LOCK]:  # nothing began
                (run / _LOCK).unlink()
        lock.release()


def worker(run: Path) -> str | None:
    """Who works on a run's folder: ``process 71 on desk since 2026-01-31 12:00:00``; None if nobody does.

    Args:
        run: the folder, which may be read-only.
    """
    if not (run / _HOLDER).exists():  # nobody is kept out for the moment that a look takes
        return None
    try:
        with FileLock(run / _LOCK, timeout=0):
            return None  # whoever held it was killed
    except (Timeout, OSError):
        return _who(run)


def _who(run: Path) -> str:
    with suppress(OSError):  # it may not have said so yet
        return (run / _HOLDER).read_text(encoding="utf-8").strip() or "another process"
    return "another process"
