"""SUMO's simulations, each in a process of its own, as libsumo holds one for each process.

Run as a program by :mod:`saferl.envs.intersection.sumo`, with the file descriptors of as many connections as it wants
simulations. It needs libsumo and nothing of saferl: messages are of plain numbers, as to unpickle a class imports its
module. Positions are SUMO's: of the middle of the front bumper, m, y up.
"""

from __future__ import annotations

import os
import signal
import sys
from itertools import starmap
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

EGO = "ego"
_LEAVE_ALONE = 2  # moveToXY puts a car exactly there, on its route or not, on the road or not


class Car(NamedTuple):
    """A car that is to enter: its number, its route, its lane as SUMO counts, the place of its front on its approach (m),
    speed and wanted speed (m/s), headway (s), and whether it is heedless."""

    number: int
    route: int
    lane: int
    front: float
    speed: float
    wanted: float
    headway: float
    heedless: bool


Pose = tuple[float, float, float]  # x, y, m; degrees clockwise from the north
Seen = list[tuple[int, float, float, float]]  # of each car that is there: number, x, y, m/s


class Simulation:
    """One simulation, whose ego is put where it is told to be."""

    def __init__(self):
        import libsumo  # pyright: ignore[reportMissingImports]  (an extra)

        self.sumo: Any = libsumo

    def begin(self, options: list[str], cars: list[tuple], route: int, pose: Pose) -> None:
        """Another episode: the ego and these cars at their places, at time 0."""
        if self.sumo.isLoaded():
            self.sumo.load(options)
        else:
            self.sumo.start(["sumo", *options])
        self.sumo.vehicle.add(EGO, str(route), typeID=EGO)
        self.sumo.vehicle.setSpeedMode(EGO, 0)
        self.sumo.vehicle.setLaneChangeMode(EGO, 0)
        self.enter(cars)
        if len(self._step(pose)) < len(cars):
            raise RuntimeError("not every car could enter")

    def enter(self, cars: list[tuple]) -> None:
        """Let these cars, each the fields of a :class:`Car`, onto the road at the end of the next step."""
        vehicle = self.sumo.vehicle
        for car in starmap(Car, cars):
            name = str(car.number)
            vehicle.add(
                name, str(car.route), typeID="heedless" if car.heedless else "car",
                departLane=str(car.lane), departPos=str(car.front), departSpeed=str(car.speed),
            )  # fmt: skip
            vehicle.setLaneChangeMode(name, 0)
            vehicle.setMaxSpeed(name, car.wanted)
            vehicle.setTau(name, car.headway)

    def move(self, poses: list[Pose]) -> list[Seen]:
        """Go on by a step for each of the ego's poses, where it then is."""
        return [self._step(pose) for pose in poses]

    def look(self, function: str, *arguments: Any) -> Any:
        """What a function of libsumo says, as ``vehicle.getAngle`` of a car."""
        domain, _, name = function.partition(".")
        return getattr(getattr(self.sumo, domain), name)(*arguments)

    def _step(self, pose: Pose) -> Seen:
        sumo, vehicle = self.sumo, self.sumo.vehicle
        vehicle.moveToXY(EGO, "", -1, *pose, _LEAVE_ALONE)
        sumo.simulationStep()
        there = [name for name in vehicle.getIDList() if name != EGO]
        return [(int(n), *vehicle.getPosition(n), vehicle.getSpeed(n)) for n in there]


def serve(connection: Connection) -> None:
    """Do what is asked, a method's name and its arguments, until nobody asks any more; answer with whether it was done and
    what it gave."""
    simulation = Simulation()
    while True:
        try:
            name, arguments = connection.recv()
        except (EOFError, OSError):
            return
        try:
            done = True, getattr(simulation, name)(*arguments)
        except Exception as error:  # told to whoever asked
            done = False, f"{type(error).__name__}: {error}"
        connection.send(done)


def main(descriptors: list[int]) -> None:
    """A process for each connection; it ends when the last of them has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started us closes us
    import libsumo  # noqa: F401  # pyright: ignore  (once for all of them)

    for mine in descriptors:
        if os.fork() == 0:
            for other in descriptors:
                if other != mine:
                    os.close(other)
            try:
                serve(Connection(mine))
            finally:
                os._exit(0)
    for descriptor in descriptors:
        os.close(descriptor)
    for _ in descriptors:
        os.wait()


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]])
