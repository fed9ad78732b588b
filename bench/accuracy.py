"""Accuracy on real data with a truth: one function per data set, SETS is the list of them.

`python -m bench accuracy` measures all and renews the section of docs/benchmarks.md; `python -m bench.accuracy husky plaza` prints some.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import yaml

from bench.drive import drive
from bench.kitti import kitti
from bench.plaza import plaza
from bench.sightings import mrclam, victoria_park_raw
from bench.stereo import stereo
from bench.table import Row, markdown
from slam_backend.core.config import config_from
from slam_backend.core.measurement import Array
from slam_backend.io.doctor import examine
from slam_backend.io.replay import replay
from slam_backend.lab.fixes import away, away_by_lines, rms

TITLE = "Accuracy on real data"
EXPLANATION = (
    "Position errors in metres against each data set's truth, with the settings named in `bench/`. Baseline: what the row names "
    "(dead reckoning, interpolation); value: ours, or what the bound is about. Sets that are not at hand are left out. "
    "MRCLAM: one setting for all robots; path and landmarks are laid over the truth by one rigid fit, that of the path (docs/sensors.md)."
)
SHARED = Path(__file__).parents[2] / "shared/data"

HUSKY = """
space: 2d
sources: [wheels, gps]
wheels: {kind: odometry, topic: /husky_velocity_controller/odom}
gps: {kind: gnss, topic: /fix}
extrinsics: {gps: [0, 0, 0, 0, 0, 0]}
"""
OUTAGES = ((80.0, 140.0), (180.0, 240.0), (300.0, 360.0))  # s


def husky() -> list[Row]:
    """A robot outdoors, its yaw unknown at the start: fixes kept back for a minute, horizontally; beside it, straight lines across."""
    bag = SHARED / "bags/robot_localization/test1.bag"
    if not bag.exists():
        return []
    made = []
    for start, end in OUTAGES:
        settings = (f"gps.withhold=[[{start}, {end}]]",)
        result = replay(bag, config_from(yaml.safe_load(HUSKY)), settings).result
        found = result.run.backend.compared(result.snapshot)
        assert found is not None
        ours, lines = (rms(each[found.withheld]) for each in (away(found), away_by_lines(found)))
        what = f"Husky, no GNSS from {start:g} to {end:g} s"
        made.append(Row(what, f"{ours:.2f} m", f"{lines:.2f} m interpolated", ours, "<= 4"))
    return [*made, *_husky_whole(bag), _husky_imu(bag)]


def _husky_whole(bag: Path) -> list[Row]:
    """With all fixes: after how many metres the yaw was known, and what each source's residuals say of its noise."""
    run = replay(bag, config_from(yaml.safe_load(HUSKY)))
    first, way = None, 0.0
    for _ in run:
        if first is None and run.backend.earth() is not None:
            snapshot = run.backend.snapshot()
            first, steps = snapshot.trajectory.sevens[0], np.diff(snapshot.odometry.sevens[:, :3], axis=0)
            way = float(np.linalg.norm(steps, axis=1).sum())
    assert first is not None
    off = _turn(
        first, run.result.snapshot.trajectory.sevens[0]
    )  # the earth holds the map: what turns is the path
    what = "Husky, way until the yaw is known"
    made = [Row(what, f"{way:.1f} m", f"{off:.2f} rad from that at the end", way, "<= 20")]
    for source, told in run.result.summary["consistency"].items():
        what = f"Husky, {source}: NIS of its residuals"
        made.append(Row(what, f"{told['chi_square']:.0f}", f"{told['expected']:.0f} expected", told["ratio"]))
    for source, told in run.result.summary["earth"]["nis"].items():
        what = f"Husky, {source}: NIS of its innovations, mean"
        made.append(
            Row(what, f"{told['mean']:.2f}", f"{told['expected']} expected", told["mean"] / told["expected"])
        )
    return made


def _turn(one: Array, other: Array) -> float:
    """rad between two poses of seven numbers."""
    return float(2 * np.arccos(min(1.0, abs(float(one[3:] @ other[3:])))))


def _husky_imu(bag: Path) -> Row:
    """Nobody has told how the IMU is mounted, gravity is on its y axis: what `slam-backend doctor` says of it."""
    found = [each.what for topic in examine([bag]).topics for each in topic.findings]
    said = [what for what in found if what.startswith("imu/sideways")]
    what = "Husky, the IMU's mounting noticed"
    return Row(what, said[0] if said else "not said", "gravity on +y, no /tf", len(said), ">= 1")


SETS: Mapping[str, Callable[[], list[Row]]] = {
    "husky": husky,
    "drive_0708": drive,
    "kitti": kitti,
    "kitti_stereo": stereo,
    "mrclam": mrclam,
    "victoria_park_raw": victoria_park_raw,
    "plaza": plaza,
}  # name -> rows; none where the data are not at hand


def rows() -> list[Row]:
    return [row for measure in SETS.values() for row in measure()]


if __name__ == "__main__":
    for name in sys.argv[1:] or SETS:
        print(markdown(name, EXPLANATION, SETS[name]()), flush=True)
