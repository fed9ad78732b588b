"""The Python interface, as people type it."""

from pathlib import Path

import numpy as np
import pytest

import slam_backend as sb
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    return write_simulation(simulate("square", 1, Options(poses=200, loop_rate=0.3)), folder / "drive.mcap")


def test_a_bag_is_replayed_update_by_update(drive):
    run = sb.replay(drive.bag, sb.load_config(drive.config))
    seen = [update.keyframe.stamp for update in run]
    trajectory = run.result.trajectory
    assert set(seen) == set(trajectory.stamps.tolist())
    assert trajectory.poses.shape == (len(trajectory), 4, 4)
    assert run.result.summary["counts"]["keyframes"] == 200


def test_paths_may_be_strings_and_the_result_may_be_asked_for_at_once(drive, tmp_path):
    result = sb.replay(str(drive.bag)).result
    sb.write_run(result, tmp_path / "run")
    assert (tmp_path / "run/trajectory.tum").exists()


def test_the_backend_takes_measurements_by_hand():
    backend = sb.Backend(sb.Config())
    for n in range(10):
        pose = frozen((n, 0, 0, 0, 0, 0, 1))
        measurement = OdometryPose(
            (n + 1) * SECOND, "odometry", "odom", "base", pose, UNKNOWN, STILL, UNKNOWN
        )
        (update,) = backend.add(measurement)
        assert update.keyframe.index == n
    poses = backend.snapshot().poses
    assert poses.shape == (10, 4, 4)
    np.testing.assert_allclose(poses[:, 0, 3], range(10), atol=1e-6)


def test_a_snapshot_is_a_copy_that_does_not_change():
    backend = sb.Backend()
    for n in range(6):
        pose = frozen((n, 0, 0, 0, 0, 0, 1))
        backend.add(OdometryPose((n + 1) * SECOND, "odometry", "odom", "base", pose, UNKNOWN, STILL, UNKNOWN))
        if n == 2:
            early = backend.snapshot()
            bytes_then = early.poses.tobytes()
    assert len(early.stamps) == 3
    assert early.poses.tobytes() == bytes_then


def test_every_mistake_is_a_slam_error():
    for name in ("BadConfig", "BadFile", "BadMessage", "MissingExtra", "SolverFailure"):
        assert issubclass(getattr(sb, name), sb.SlamError)
    with pytest.raises(sb.BadFile, match=r"nowhere\.mcap"):
        sb.replay(Path("nowhere.mcap"))
    with pytest.raises(sb.BadConfig, match=r"nowhere\.yaml"):
        sb.load_config("nowhere.yaml")


def test_all_that_is_promised_can_be_imported():
    assert all(getattr(sb, name) is not None for name in sb.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Bakend'"):
        _ = sb.Bakend
