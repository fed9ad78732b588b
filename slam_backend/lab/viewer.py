"""A run in a Rerun viewer (rerun.io, an extra): the path as it is believed at each moment, loops by verdict, landmarks, residuals."""

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ..core.backend import Update
from ..core.errors import BadConfig, MissingExtra
from ..core.graph import Decision
from ..core.measurement import Array
from ..core.trajectory import Snapshot, Trajectory
from ..io.replay import Run
from .colours import LANDMARK, ODOMETRY, ONLINE, SMOOTHED, VERDICTS

SHARE = 0.1  # of the run's time that drawing whole maps may take
TIMELINE = "stamp"
FILE, ADDRESS = ".rrd", "rerun+http://"


class Viewer:
    """Watches a run from outside: `see` each update as it comes, `finish` once it has ended."""

    def __init__(self, run: Run, target: str) -> None:
        """target: an .rrd file, the address of a viewer (rerun+http://HOST:PORT/proxy), or `spawn` for a new one here."""
        self._run, self._rerun = run, _rerun()
        self._stream = self._rerun.RecordingStream("slam_backend")
        self._loops: dict[str, Decision] = {}
        self._trail: list[tuple[float, ...]] = []
        self._begin, self._spent = perf_counter(), 0.0
        if target == "spawn":
            self._stream.spawn()
        elif target.endswith(FILE):
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(target)
        elif target.startswith(ADDRESS):
            self._stream.connect_grpc(target)
        else:
            raise BadConfig(
                f"--rerun {target}: name a file that ends in {FILE}, an address {ADDRESS}HOST:PORT/proxy, or spawn"
            )

    def see(self, update: Update) -> None:
        self._loops |= {each.id: each for each in update.decisions if each.ends is not None}
        self._trail.append(update.pose[:3])
        self._time(update.keyframe.stamp)
        self._stream.log(
            "map/newest", self._rerun.Points3D([update.pose[:3]], colors=[_rgb(ONLINE)], radii=[0.15])
        )
        self._stream.log("update/ms", self._rerun.Scalars(self._run.seconds.last_ms))
        self._stream.log("update/factors", self._rerun.Scalars(len(self._run.backend.solver.factors)))
        if self._spent <= SHARE * (perf_counter() - self._begin):
            self._map()

    def finish(self) -> None:
        """The whole map as it is at the end, and how every factor fits."""
        self._map()
        values = self._run.result.values
        for factor in self._run.result.factors:
            if factor.kind != "gauge":
                self._time(factor.stamp)
                self._stream.log(
                    f"residual/{factor.source}", self._rerun.Scalars(np.sqrt(2 * factor.factor.error(values)))
                )
        self._stream.flush()

    def _map(self) -> None:
        begin = perf_counter()
        snapshot = self._run.backend.snapshot()
        self._line("map/smoothed", snapshot.trajectory.sevens[:, :3], SMOOTHED)
        self._line("map/online", np.array(self._trail), ONLINE)
        self._line("map/odometry", snapshot.odometry.sevens[:, :3], ODOMETRY)
        self._draw_loops(snapshot.trajectory)
        self._draw_landmarks(snapshot)
        self._spent += perf_counter() - begin

    def _draw_loops(self, trajectory: Trajectory) -> None:
        for verdict in dict.fromkeys(each.verdict for each in self._loops.values()):
            ends = [each.ends for each in self._loops.values() if each.verdict == verdict]
            places = trajectory.at(np.array(ends).ravel())[:, :3].reshape(-1, 2, 3)
            there = places[np.isfinite(places).all(axis=(1, 2))]
            self._stream.log(
                f"map/loops/{verdict}", self._rerun.LineStrips3D(there, colors=[_rgb(VERDICTS[verdict])])
            )

    def _draw_landmarks(self, snapshot: Snapshot) -> None:
        if snapshot.names:
            points = self._rerun.Points3D(
                snapshot.landmarks,
                colors=[_rgb(LANDMARK)],
                labels=snapshot.names,
                show_labels=False,
                radii=[0.1],
            )
            self._stream.log("map/landmarks", points)

    def _line(self, name: str, points: Array, colour: str) -> None:
        self._stream.log(name, self._rerun.LineStrips3D([points], colors=[_rgb(colour)]))

    def _time(self, stamp: int) -> None:
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(stamp, "ns"))


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise MissingExtra(
            "--rerun needs the Rerun SDK, which is not installed: pip install 'slam_backend[rerun]'"
        ) from None
    return rerun


def _rgb(colour: str) -> list[int]:
    return list(bytes.fromhex(colour[1:]))
