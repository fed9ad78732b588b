"""Many landmarks: ten seen from each of 2,000 keyframes, 800 in all, and what an update costs then."""

from time import process_time

import numpy as np

from bench.table import Row
from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.solvers.batch import polish
from slam_backend.core.trajectory import Trajectory
from slam_backend.lab.options import Options
from slam_backend.lab.sensing import LANDMARKS_EVERY
from slam_backend.lab.simulate import Simulation, simulate
from slam_backend.lab.world import STEP

TITLE = "Many landmarks"
EXPLANATION = (
    "Through the streets of a simulated city of 90 m by 90 m, 800 landmarks in it, about ten seen from each of 2,000 keyframes. CPU time of an update, "
    "and the error of the final estimate against that of the batch optimum of the same factors. Dense: 10,000 landmarks, from 1,000 keyframes; stated, not promised."
)


def rows() -> list[Row]:
    return measured(800, 5.6, 2000, "<= 60") + measured(10_000, 1.6, 1000, "")


def measured(landmarks: int, reach: float, keyframes: int, must: str) -> list[Row]:
    drive = simulate(
        "city", 1,
        Options(poses=keyframes * LANDMARKS_EVERY, landmarks=landmarks, landmark_range=reach, loop_rate=0.0),
    )  # fmt: skip
    step = 0.9 * STEP * LANDMARKS_EVERY
    backend = Backend(config_from({**drive.settings, "keyframes": {"distance": step, "angle": 6.0}}))
    updates = []
    for item in drive.measurements:
        before = process_time()
        if backend.add(item):
            updates.append(1e3 * (process_time() - before))
    p50, p99 = np.percentile(updates, (50, 99))
    ours = error(drive, backend.snapshot().trajectory)
    best = polish(backend.solver.factors.values(), backend.estimate.values())
    backend.adopt(best.values)
    batch = error(drive, backend.snapshot().trajectory)
    seen = sum(f.kind == "landmark" for f in backend.solver.factors.values()) / len(updates)
    what = f"{len(backend.snapshot().names)} landmarks, {seen:.1f} seen from each of {len(updates)} keyframes"
    return [
        Row(f"{what}: p99 of an update", f"{p99:.1f} ms", f"{p50:.1f} ms median", float(p99), must),
        Row("their RMSE", f"{ours:.4f} m", f"{batch:.4f} m batch", ours / batch, "<= 1.1" if must else ""),
    ]


def error(drive: Simulation, found: Trajectory) -> float:
    """Root mean square of the positions (m); both begin at the origin."""
    rows = np.searchsorted(drive.stamps, found.stamps)
    gaps = np.linalg.norm(found.sevens[:, :3] - drive.sevens[rows, :3], axis=1)
    return float(np.sqrt((gaps**2).mean()))
