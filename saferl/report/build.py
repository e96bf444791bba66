"""From folders of runs to the numbers of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from saferl.report.claims import Claim, answers
from saferl.report.curves import Curve, curves
from saferl.report.drivers import DRIVERS, drive
from saferl.report.runs import Run, find
from saferl.report.systems import LABELS, System, gather
from saferl.report.tables import Effort, Table, efforts, tables


@dataclass(frozen=True)
class Report:
    """All numbers of a report.

    Attributes:
        runs: every run that was found, with its state.
        systems: the drivers, then what was trained.
        tables: the paper's.
        efforts: what each system took, and how it stands to ``against``.
        claims: the paper's, answered.
        curves: by figure and system.
        against: name of the system that others are compared with.
    """

    runs: Sequence[Run]
    systems: Sequence[System]
    tables: Sequence[Table]
    efforts: Sequence[Effort]
    claims: Sequence[Claim]
    curves: Mapping[str, Mapping[str, Curve]]
    against: str


def build(folders: Sequence[Path], out: Path, against: str = "arsac") -> Report:
    """Read all runs below these folders, and play what is missing of the drivers' tests into ``out/drivers``.

    Args:
        folders: of runs.
        out: folder of the report.
        against: name of the system that the others are compared with.

    Raises:
        ValueError: a folder is not there, or none of ``against``'s name is known.
    """
    runs = find(folders)
    known = dict.fromkeys([*LABELS, *(run.algo for run in runs if run.algo)])
    if against not in known or against in DRIVERS:
        known = [name for name in known if name not in DRIVERS]
        raise ValueError(f"--against must be among {', '.join(known)}, got {against!r}.")
    if runs:
        out.mkdir(parents=True, exist_ok=True)
    systems = [*drive(runs, out / "drivers"), *gather(runs)]
    return Report(
        runs,
        systems,
        tables(systems),
        efforts(systems, against),
        answers(systems),
        curves(runs),
        against,
    )
