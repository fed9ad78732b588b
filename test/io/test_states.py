"""A flight with an IMU, as a run directory: velocities and biases in a file, in queries, and in a map that is continued."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadFile
from slam_backend.core.query import answers
from slam_backend.io.finished import FinishedRun
from slam_backend.io.mapfile import read_map
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.io.states import read_states
from slam_backend.lab.ekf import Ekf
from slam_backend.lab.simulate import Options, simulate, write_simulation

OPTIONS = Options(poses=60, period=0.5, imu_rate=50, loop_rate=0.0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The bag of a flight up a spiral, and its run directory."""
    folder = tmp_path_factory.mktemp("flight")
    made = simulate("spiral", 1, OPTIONS)
    bag = write_simulation(made, folder / "flight.mcap").bag
    result = replay(bag, config_from(made.settings)).result
    write_run(result, folder / "run")
    return bag, made, result, folder / "run"


def test_the_file_says_what_the_run_believed(flown):
    _, _, result, folder = flown
    states = read_states(folder / "velocities.csv")
    np.testing.assert_array_equal(states.stamps, result.snapshot.states.stamps)
    np.testing.assert_array_equal(states.numbers, result.snapshot.states.numbers)
    assert (
        len(states.stamps) == len(result.snapshot.stamps) - 1
    )  # the IMU's first sample is later than the first odometry


def test_a_finished_run_answers_for_velocity_and_bias(flown):
    _, _, result, folder = flown
    velocity, bias = answers(["velocity@now", "bias@now"], FinishedRun(folder))
    np.testing.assert_array_equal(velocity.value, result.snapshot.states.numbers[-1, :3])
    assert abs(np.linalg.norm(velocity.value) - 1) < 0.1
    assert bias.value.shape == (6,)


def test_the_graph_file_has_poses_only(flown):
    folder = flown[-1]
    assert len((folder / "graph.g2o").read_text().splitlines()) == 60 + 59


def test_a_damaged_file_is_said(flown, tmp_path: Path):
    _, _, _, folder = flown
    broken = tmp_path / "velocities.csv"
    broken.write_text((folder / "velocities.csv").read_text()[:-40])
    with pytest.raises(BadFile, match=r"velocities\.csv:60: is damaged"):
        read_states(broken)


def test_the_same_flight_gives_the_same_hash_and_a_batch_the_same_flight(flown):
    bag, made, result, _ = flown
    again = replay(bag, config_from(made.settings), final="batch").result
    assert replay(bag, config_from(made.settings)).result.summary["run_hash"] == result.summary["run_hash"]
    np.testing.assert_allclose(again.snapshot.trajectory.sevens, result.snapshot.trajectory.sevens, atol=1e-3)


def test_a_filter_takes_the_same_factors(flown):
    bag, made, result, _ = flown
    filtered = replay(bag, config_from(made.settings), estimator=Ekf).result
    away = np.linalg.norm(
        (filtered.snapshot.trajectory.sevens - result.snapshot.trajectory.sevens)[:, :3], axis=1
    )
    assert away.max() < 1.0


@pytest.mark.parametrize("drives", [True, False])
def test_a_map_with_velocities_and_biases_is_continued(flown, tmp_path: Path, drives: bool):
    """Where the IMU drove, too: the motion that its factors stand for is in the map."""
    bag, made, _, _ = flown
    settings = dict(made.settings)
    if drives:
        settings |= {"sources": ["imu"], "keyframes": {"distance": 100.0, "angle": 6.0}}
        settings = {name: value for name, value in settings.items() if name not in ("wheels", "loops")}
    first = replay(bag, config_from(settings)).result
    write_run(first, tmp_path / "first")
    later = simulate("spiral", 2, OPTIONS)
    shift = 100 * 10**9
    moved = [replace(item, stamp=item.stamp + shift) for item in later.measurements]
    backend = Backend(config_from(settings))
    backend.load(read_map(tmp_path / "first"))
    names = config_from(settings).sources
    for item in sorted(moved, key=lambda m: m.stamp):
        if item.source in names:
            backend.add(item)
    backend.finish()
    kept = {key: factor.motion for key, factor in backend.solver.factors.items() if factor.kind == "motion"}
    assert any(motion is not None for motion in kept.values()) == drives
    assert len(backend.snapshot().states.stamps) > len(first.snapshot.states.stamps) * 1.5
    for name, motion in kept.items():
        before = first.run.backend.solver.factors.get(name)
        if before is not None and before.motion is not None:
            assert gtsam.Pose3.equals(motion.pose, before.motion.pose, 1e-12)
