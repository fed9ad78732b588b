"""KITTI by IMU and GNSS: every tenth fix is kept back, and what is believed there compared with it."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from gtsam.symbol_shorthand import B

from bench.table import Row
from slam_backend.core.fixes import Compared
from slam_backend.core.measurement import SECOND, Array
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.io.result import Result
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.fixes import away, away_by_lines, rms

CONFIG = Path(__file__).parents[1] / "config/kitti_imu_gnss.yaml"
EVERY, OFFSETS = 10, (0, 2, 5, 7)
SETTLED = 20  # fixes at the start that are all used


def kitti() -> list[Row]:
    """Horizontally; beside it, straight lines between the fixes before and after. How large the biases become."""
    with TemporaryDirectory() as folder:
        bag = make_dataset("kitti_imu_gnss", Path(folder) / "kitti.mcap").path
        stamps = compared(replay(bag, load_config(CONFIG)).result).stamps
        return [row for offset in OFFSETS for row in _withheld(bag, stamps, offset)]


def _withheld(bag: Path, stamps: Array, offset: int) -> list[Row]:
    seconds = (stamps - stamps[0]) / SECOND
    n = np.arange(SETTLED, len(stamps) - 1)
    spans = [[t - 0.01, t + 0.01] for t in seconds[n[n % EVERY == offset]].tolist()]
    result = replay(bag, load_config(CONFIG), settings=(f"gps.withhold={spans}",)).result
    found = compared(result)
    ours, theirs = (rms(each[found.withheld]) for each in (away(found), away_by_lines(found)))
    what = f"KITTI by IMU and GNSS, every 10th fix kept back from number {offset}"
    acceleration, rate = biases(result)
    return [
        Row(what, f"{ours:.3f} m", f"{theirs:.2f} m interpolated", ours, "<= 0.20"),
        Row(f"{what}: against interpolation", f"{ours:.3f} m", f"{theirs:.2f} m", ours / theirs, "<= 0.35"),
        Row(f"{what}: largest biases", f"{acceleration:.3f} m/s^2, {rate:.4f} rad/s", "-", acceleration, "<= 0.2"),
    ]  # fmt: skip


def biases(result: Result) -> tuple[float, float]:
    """Largest of the accelerometer (m/s^2) and of the gyroscope (rad/s), on any axis."""
    backend = result.run.backend
    found = np.abs([backend.estimate.value(int(B(k.index))).vector() for k in backend.timeline.keyframes])
    return float(found[:, :3].max()), float(found[:, 3:].max())


def compared(result: Result) -> Compared:
    found = result.run.backend.compared(result.snapshot)
    assert found is not None
    return found
