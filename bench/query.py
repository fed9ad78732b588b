"""Poses at any stamp, against a loop over gtsam's own interpolation."""

from bisect import bisect_right
from statistics import median
from time import process_time
from typing import Any

import gtsam
import numpy as np

from bench.table import Row
from slam_backend.core.trajectory import Stamps, Trajectory, shaped

TITLE = "Poses at any stamp"
EXPLANATION = (
    "CPU milliseconds for 10,000 stamps, in order, over 100,000 keyframes with four odometry samples to each: ours in one call, from "
    "arrays to an array of x y z qx qy qz qw, against a Python loop over `gtsam.Pose3.slerp` between poses that exist as gtsam "
    "objects, with a binary search for each stamp and the same seven numbers as its answer; medians of alternating runs. "
    "`shaped` follows the odometry between keyframes and meets both. Last row: a loop that stops at 4x4 matrices."
)
POSES, STAMPS, SAMPLES, PASSES = 100_000, 10_000, 4, 15
BOUND = "<= 0.2"


def rows() -> list[Row]:
    keyframes, odometry, wanted = drive(np.random.default_rng(1))
    objects = [gtsam.Pose3(pose) for pose in keyframes.poses]
    stamps = keyframes.stamps.tolist()
    work = {
        "loop": lambda: loop(stamps, objects, wanted.tolist(), seven),
        "loop to 4x4": lambda: loop(stamps, objects, wanted.tolist(), gtsam.Pose3.matrix),
        "plain": lambda: keyframes.at(wanted),
        "shaped": lambda: shaped(keyframes, odometry, wanted),
    }
    runs = [{name: _seconds(each) for name, each in work.items()} for _ in range(PASSES)]
    spent = {name: median(run[name] for run in runs) for name in work}
    return [
        _row("plain", spent, "loop", BOUND),
        _row("shaped", spent, "loop", BOUND),
        _row("shaped", spent, "loop to 4x4"),
    ]


def _row(name: str, spent: dict[str, float], baseline: str, must: str = "") -> Row:
    own, theirs = spent[name], spent[baseline]
    return Row(f"{name} / {baseline}", f"{own * 1e3:.1f} ms", f"{theirs * 1e3:.1f} ms", own / theirs, must)


def drive(rng: np.random.Generator) -> tuple[Trajectory, Trajectory, Stamps]:
    """Keyframes, odometry and (STAMPS,) stamps: a wandering path in 3-D, the odometry another with the same stamps."""
    stamps = np.arange(POSES * SAMPLES, dtype=np.int64) * 25_000_000 + 1_700_000_000_000_000_000

    def path() -> Trajectory:
        positions = np.cumsum(rng.normal(0.1, 0.05, (len(stamps), 3)), axis=0)
        quaternions = np.cumsum(rng.normal(0, 0.01, (len(stamps), 4)), axis=0) + np.array([0, 0, 0, 3])
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        return Trajectory(stamps, np.hstack([positions, quaternions]))

    truth = path()
    keyframes = Trajectory(stamps[::SAMPLES].copy(), truth.sevens[::SAMPLES].copy())
    return keyframes, path(), np.sort(rng.integers(stamps[0], keyframes.stamps[-1], STAMPS))


def loop(stamps: list[int], poses: list[Any], wanted: list[int], answer: Any) -> np.ndarray[Any, Any]:
    """What one would write without us."""
    found = []
    for stamp in wanted:
        left = bisect_right(stamps, stamp) - 1
        ratio = (stamp - stamps[left]) / (stamps[left + 1] - stamps[left])
        found.append(answer(poses[left].slerp(ratio, poses[left + 1])))
    return np.array(found)


def seven(pose: Any) -> tuple[float, ...]:
    q = pose.rotation().toQuaternion()
    return (*pose.translation(), q.x(), q.y(), q.z(), q.w())


def _seconds(work: Any) -> float:
    begin = process_time()
    work()
    return process_time() - begin


if __name__ == "__main__":
    for row in rows():
        print(row)
