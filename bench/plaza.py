"""Plaza: a lawn mower with radio ranges to four beacons, nobody knows where, all of them too long by the same factor."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.table import Row
from slam_backend.core.measurement import Array
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.configfile import load_config
from slam_backend.io.formats import tum
from slam_backend.io.replay import replay
from slam_backend.lab.datasets import beacons, make_dataset

CONFIG = Path(__file__).parents[1] / "config/plaza.yaml"
BOUNDS = {"plaza1": ("<= 0.40", "<= 0.5"), "plaza2": ("<= 0.35", "<= 0.8")}  # m: at the end, and as it went


def plaza() -> list[Row]:
    """After a rigid alignment with the path's truth; the beacons by the same one."""
    with TemporaryDirectory() as folder:
        return [row for name in BOUNDS for row in _rows(name, Path(folder))]


def _rows(name: str, folder: Path) -> Iterator[Row]:
    made = make_dataset(name, folder / f"{name}.mcap")
    assert made.truth is not None
    run = replay(made.path, load_config(CONFIG))
    snapshot, truth = run.result.snapshot, tum.read(made.truth)
    lost, *_ = _laid(snapshot.odometry, truth)
    ate, turn, shift = _laid(snapshot.trajectory, truth)
    causal, *_ = _laid(run.online, truth)
    must, must_causal = BOUNDS[name]
    yield Row(f"{name}, ranges only", f"{ate:.3f} m", f"{lost:.2f} m dead reckoning", ate, must)
    yield Row(f"{name}, as it went", f"{causal:.3f} m", f"{lost:.2f} m dead reckoning", causal, must_causal)
    places = dict(zip(snapshot.names, snapshot.landmarks, strict=True))
    off = max(float(np.linalg.norm(turn @ places[b][:2] + shift - true)) for b, true in beacons(name).items())
    yield Row(f"{name}, the worst of 4 beacons", f"{off:.3f} m", "unknown at the start", off, "<= 0.3")
    scale = run.backend.calibration.found["ranges"]["range_scale"]
    away = abs(scale.value - 1.07)
    yield Row(
        f"{name}, scale of the ranges, off 1.07",
        f"{scale.value:.4f} ± {scale.sigma:.4f}",
        "1",
        away,
        "<= 0.01",
    )


def _laid(estimate: Trajectory, truth: Trajectory) -> tuple[float, Array, Array]:
    """Root mean square distance to the truth, in m, after the rotation and shift that make it smallest (Umeyama, PAMI 1991)."""
    ours = estimate.sevens[:, :2]
    theirs = np.stack([np.interp(estimate.stamps, truth.stamps, axis) for axis in truth.sevens.T[:2]], axis=1)
    u, _, vt = np.linalg.svd((theirs - theirs.mean(axis=0)).T @ (ours - ours.mean(axis=0)))
    turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    shift = theirs.mean(axis=0) - turn @ ours.mean(axis=0)
    return float(np.sqrt(((ours @ turn.T + shift - theirs) ** 2).sum(axis=1).mean())), turn, shift
