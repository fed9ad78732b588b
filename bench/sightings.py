"""Landmarks on real data: MRCLAM, whose landmarks have ids, and Victoria Park as recorded, whose trees have none."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.table import Row
from slam_backend.core.geometry import matrix_of
from slam_backend.core.measurement import Array
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.configfile import load_config
from slam_backend.io.formats import tum
from slam_backend.io.replay import Result, replay
from slam_backend.lab import mrclam as folder_of
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.victoria_raw import LASER

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared/data"
OFTEN = 20  # sightings that make a tree a tree

Fit = Callable[[Array], Array]  # of points in the map to the frame of the truth


def mrclam() -> list[Row]:
    """Robots 1 to 3, landmarks unknown at the start; the path fitted to the truth as a whole, and the landmarks by the same fit."""
    folder = SHARED / "mrclam_raw/MRCLAM_Dataset6"
    if not folder.exists():
        return []
    made = []
    for robot, must in ((1, "<= 0.15"), (2, "<= 0.25"), (3, "<= 0.25")):
        result, truth = replayed(f"mrclam{robot}", folder, "mrclam.yaml")
        snapshot, known = result.snapshot, folder_of.landmarks(folder)
        final, fit = laid_over(result.trajectory, truth)
        causal, alone = (_rms(laid_over(each, truth)[0]) for each in (result.run.online, snapshot.odometry))
        points = fit(snapshot.landmarks[:, :2])
        gaps = np.linalg.norm(points - [known[name] for name in snapshot.names], axis=1)
        what, beside = f"MRCLAM robot {robot}", f"{alone:.2f} m odometry"
        made += [
            Row(what, f"{_rms(final):.3f} m", beside, _rms(final), must),
            Row(f"{what}, causal", f"{causal:.3f} m", beside, causal, "<= 0.20" if robot == 1 else ""),
            Row(f"{what}, landmarks", f"{_rms(gaps):.3f} m", "-", _rms(gaps), "<= 0.10"),
        ]
    return made


def victoria_park_raw() -> list[Row]:
    """All fixes, those that jump included, against the laser's place; trees without ids."""
    folder = SHARED / "victoria_park_raw"
    if not folder.exists():
        return []
    result, truth = replayed("victoria_park_raw", folder, "victoria_park_raw.yaml")
    gaps, causal, alone = (
        laid_over(_at_laser(each), truth)[0]
        for each in (result.trajectory, result.run.online, result.snapshot.odometry)
    )
    seen = Counter(f.keys[1] for f in result.factors if f.kind == "landmark")
    trees = sum(count >= OFTEN for count in seen.values())
    what, beside = "Victoria Park raw", f"{_rms(alone):.1f} m odometry"
    return [
        Row(what, f"{_rms(gaps):.2f} m RMS", beside, _rms(gaps), "<= 4"),
        Row(
            f"{what}, median",
            f"{np.median(gaps):.2f} m",
            f"{np.median(alone):.1f} m",
            float(np.median(gaps)),
            "<= 1.5",
        ),
        Row(f"{what}, causal", f"{_rms(causal):.2f} m RMS", beside, _rms(causal)),
        Row(f"{what}, trees seen {OFTEN} times", f"{trees}", f"{len(seen)} landmarks", trees, ">= 150"),
        Row(f"{what}, not too many", f"{trees}", f"{len(seen)} landmarks", trees, "<= 320"),
    ]


def replayed(name: str, folder: Path | None, config: str) -> tuple[Result, Trajectory]:
    with TemporaryDirectory() as place:
        made = make_dataset(name, Path(place) / "drive.mcap", folder=folder)
        assert made.truth is not None
        truth = tum.read(made.truth)
        result = replay(made.path, load_config(ROOT / "config" / config)).result
        result.snapshot  # noqa: B018  # before the bag goes
    return result, Trajectory(truth.stamps, truth.sevens)


def _at_laser(trajectory: Trajectory) -> Trajectory:
    base_T_laser = np.eye(4)
    base_T_laser[:3, 3] = LASER[:3]
    sevens = trajectory.sevens.copy()
    sevens[:, :3] = (matrix_of(sevens) @ base_T_laser)[:, :3, 3]
    return Trajectory(trajectory.stamps, sevens)


def laid_over(trajectory: Trajectory, truth: Trajectory) -> tuple[Array, Fit]:
    """(N,) m at the truth's stamps, once the path is laid over it as a whole (Umeyama, PAMI 1991, in the plane); and the fit."""
    inside = (truth.stamps >= trajectory.stamps[0]) & (truth.stamps <= trajectory.stamps[-1])
    stamps, there = truth.stamps[inside], truth.sevens[inside, :2]
    here = np.stack([np.interp(stamps, trajectory.stamps, trajectory.sevens[:, k]) for k in (0, 1)], axis=1)
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])

    def fit(points: Array) -> Array:
        return np.asarray((points - here.mean(axis=0)) @ turn.T + there.mean(axis=0))

    return np.linalg.norm(fit(here) - there, axis=1), fit


def _rms(gaps: Array) -> float:
    return float(np.sqrt((gaps**2).mean()))
