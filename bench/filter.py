"""The smoother beside an extended Kalman filter over the same factors: errors against the truth of simulated drives."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.table import Row
from slam_backend.core.measurement import Array
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.lab.ekf import CLONES, ESTIMATORS
from slam_backend.lab.evaluate import evaluate
from slam_backend.lab.simulate import Options, simulate, write_simulation

TITLE = "The smoother beside a filter"
EXPLANATION = (
    "Ten simulated drives of 500 poses each, with loops (the warehouse has landmarks too); median ATE in m after rigid alignment. "
    f"Baseline: an extended Kalman filter with landmarks and the newest {CLONES} keyframes in its state, over the same factors "
    "(`replay --estimator ekf`). `at the time`: what was believed of each keyframe when it was newest."
)
OPTIONS = Options(poses=500, loop_rate=0.5)
SEEDS = 10


def rows() -> list[Row]:
    return [row for scenario in ("square", "spiral", "warehouse") for row in _rows(scenario)]


def _rows(scenario: str) -> Iterator[Row]:
    found = np.array([_errors(scenario, seed) for seed in range(SEEDS)])
    (filter_, filter_online), (smoother, online), odometry = (
        *np.median(found[:, :2], axis=0),
        np.median(found[:, 2, 0]),
    )
    yield Row(f"{scenario}: ATE", f"{smoother:.3f} m", f"{filter_:.3f} m", smoother / filter_)
    yield Row(
        f"{scenario}: ATE at the time", f"{online:.3f} m", f"{filter_online:.3f} m", online / filter_online
    )
    yield Row(
        f"{scenario}: ATE beside odometry alone",
        f"{smoother:.3f} m",
        f"{odometry:.3f} m",
        smoother / odometry,
    )
    wins = int((found[:, 1, 0] < found[:, 0, 0]).sum())
    yield Row(f"{scenario}: drives with the better ATE", f"{wins} of {SEEDS}", "", wins / SEEDS, ">= 0.95")


def _errors(scenario: str, seed: int) -> Array:
    """(3, 2) ATE at the end and at the time, of filter, smoother and odometry."""
    simulation = simulate(scenario, seed, OPTIONS)
    truth = Trajectory(simulation.stamps, simulation.sevens)
    found = []
    with TemporaryDirectory() as folder:
        written = write_simulation(simulation, Path(folder) / "drive.mcap")
        for name in ("ekf", "isam2"):
            result = replay(written.bag, load_config(written.config), estimator=ESTIMATORS[name]).result
            found.append([_ate(result.trajectory, truth), _ate(result.run.online, truth)])
        odometry = _ate(result.snapshot.odometry, truth)
    return np.array([*found, [odometry, odometry]])


def _ate(estimate: Trajectory, truth: Trajectory) -> float:
    return evaluate(estimate, truth).ate["rmse"]
