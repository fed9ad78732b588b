"""~/odometry at the rate of an IMU: the newest keyframe's state, carried on by the samples since."""

import numpy as np
import pytest
import yaml

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.geometry import matrix_of
from slam_backend.core.measurement import SECOND, ImuSample, StaticTransform, frozen
from slam_backend.lab.simulate import Options, simulate
from slam_backend.ros.propagation import Propagator

COVARIANCE = np.diag([1e-4] * 6).ravel()


@pytest.fixture(scope="module")
def flight():
    """Up a spiral at 1 m/s; odometry and IMU. The settings, the samples, the updates of the back-end, and the truth."""
    made = simulate("spiral", 3, Options(poses=40, period=0.5, imu_rate=50, loop_rate=0.0))
    backend, updates = Backend(config_from(made.settings)), []
    for item in sorted(made.measurements, key=lambda m: (m.stamp, m.source == "wheels")):
        updates += backend.add(item)
    samples = [item for item in made.measurements if isinstance(item, ImuSample)]
    return config_from(made.settings), samples, updates, made


def test_between_two_answers_the_robot_goes_where_its_imu_says(flight):
    """The update of a keyframe comes 0.3 s late; a second later the path is still that of the robot."""
    config, samples, updates, made = flight
    propagator, update = Propagator(config), updates[20]
    begin, found = update.keyframe.stamp, None
    for sample in samples:
        if sample.stamp <= begin + SECOND:
            known = update if sample.stamp >= begin + 3 * SECOND // 10 else None
            found = propagator.carry(sample, known, COVARIANCE)
            assert (found is not None) == (known is not None)
    n = made.stamps.tolist().index(begin)
    believed, truth = matrix_of(np.array([update.pose, found.seven])), matrix_of(made.sevens[[n, n + 2]])
    moved, wanted = (np.linalg.inv(a) @ b for a, b in (believed, truth))
    np.testing.assert_allclose(moved[:3, 3], wanted[:3, 3], atol=0.1)
    assert abs(np.linalg.norm(found.twist[:3]) - 1) < 0.1
    assert (np.diag(found.covariance.reshape(6, 6)) > 1e-4).all()
    assert propagator.carries(begin + SECOND)
    assert not propagator.carries(begin + 2 * SECOND)


def test_a_sample_that_is_old_or_from_nowhere_carries_nothing(flight):
    config, samples, updates, _ = flight
    propagator = Propagator(config)
    assert propagator.carry(samples[-1], updates[-1], None) is not None
    assert propagator.carry(samples[-2], updates[-1], None) is None
    lost = ImuSample(
        samples[-1].stamp + 1, "imu", "imu_link", *(getattr(samples[-1], name) for name in
        ("rate", "acceleration", "rate_covariance", "acceleration_covariance")),
    )  # fmt: skip
    assert propagator.carry(lost, updates[-1], None) is None
    propagator.mounted(StaticTransform(1, "", "base", "imu_link", frozen([0, 0, 0, 0, 0, 0, 1])))
    assert propagator.carry(lost, updates[-1], None) is not None


def test_without_an_imu_nothing_is_carried(flight):
    _, samples, updates, _ = flight
    plain = config_from({"sources": ["wheels"], "wheels": {"kind": "odometry"}})
    assert Propagator(plain).carry(samples[0], updates[0], None) is None


def test_a_node_with_nothing_but_an_imu_tells_where_it_is_at_its_rate(backend, peer, tmp_path):
    """Over DDS; the run is that of the journal's replay."""
    made = simulate("spiral", 5, Options(poses=40, period=0.5, imu_rate=100, loop_rate=0.0))
    kept = ("space", "base_frame", "imu")
    settings = {name: made.settings[name] for name in kept} | {
        "sources": ["imu"],
        "keyframes": {"distance": 100.0},
    }
    path = tmp_path / "imu.yaml"
    path.write_text(yaml.safe_dump(settings))
    records = [record for record in made.records if record.topic == "/imu"]
    node = backend(path)
    heard = peer.hear("/slam_backend/odometry", "nav_msgs/msg/Odometry")
    poses = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    peer.play(records, rate=5, extra=[(500, lambda: peer.until(lambda: poses))])
    peer.until(lambda: len(heard) > 1000)
    stamps = [told.header.stamp.sec * SECOND + told.header.stamp.nanosec for told in heard]
    assert np.median(np.diff(stamps)) == SECOND // 100
    summary = node.end()
    assert summary["counts"]["records"] == len(records)
    assert summary["run_hash"] == node.replayed()["run_hash"]
