"""A simulated city: the smoothed trajectory against the truth, beside a batch solve with the true covariances."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.table import Row
from slam_backend.core.measurement import Array
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.lab.evaluate import evaluate
from slam_backend.lab.simulate import simulate, write_simulation

TITLE = "A simulated city, seed 1, 5,000 poses"
EXPLANATION = (
    "Absolute trajectory error (RMS of positions after rigid alignment), online estimate polished as at the end of every replay. "
    "Baseline: the optimum of the graph with the covariances that the simulation used. `without a configuration`: sources found by type, "
    "default noise, a keyframe each half metre."
)


def rows() -> list[Row]:
    with TemporaryDirectory() as folder:
        written = write_simulation(simulate("city", 1), Path(folder) / "city.mcap")
        config = load_config(written.config)
        truth = Trajectory(*_truth(Path(folder) / "city.truth.tum"))
        runs = [replay(written.bag, config), replay(written.bag), replay(written.bag, config, final="batch")]
        ours, plain, batch = (ate(run.result.trajectory, truth) for run in runs)
        drift = runs[0].result.snapshot.odometry
    end = float(np.linalg.norm((drift.sevens[-1] - truth.at(drift.stamps[-1:])[0])[:3]))
    return [
        Row("odometry alone, at its end", f"{end:.1f} m off", "", end, ">= 10"),
        Row("smoothed", f"{ours:.3f} m", f"{batch:.3f} m", ours / batch, "<= 1.1"),
        Row("smoothed, without a configuration", f"{plain:.3f} m", f"{batch:.3f} m", plain / batch),
    ]


def _truth(path: Path) -> tuple[Array, Array]:
    from slam_backend.io.formats import read_trajectory

    found = read_trajectory(path)
    return found.stamps, found.sevens


def ate(trajectory: Trajectory, truth: Trajectory) -> float:
    """Position RMSE after the rigid alignment of least squares."""
    return evaluate(trajectory, truth).ate["rmse"]


if __name__ == "__main__":
    for row in rows():
        print(row)
