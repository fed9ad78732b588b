"""The simulated IMU feels the true motion, and errs as its options say."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.errors import BadConfig
from slam_backend.core.geometry import matrix_of
from slam_backend.core.measurement import ImuSample
from slam_backend.io.cdr import Decoder
from slam_backend.io.typestore import typestore_of
from slam_backend.lab.inertia import erring, felt, velocities
from slam_backend.lab.simulate import Options, simulate

FLIGHT = Options(poses=60, period=0.5, imu_rate=100)


@pytest.mark.parametrize("scenario", ["spiral", "square"])
def test_without_noise_preintegration_ends_where_the_robot_does(scenario: str) -> None:
    truth = simulate(scenario, 1, FLIGHT)
    poses = matrix_of(truth.sevens)
    exact = felt(poses, truth.stamps.tolist(), FLIGHT.imu_rate)
    speed = velocities(poses[:, :3, 3], FLIGHT.period, 50)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    measured = gtsam.PreintegratedCombinedMeasurements(params)
    for acceleration, rate in zip(exact.accelerations, exact.rates, strict=True):
        measured.integrateMeasurement(acceleration, rate, 0.01)
    start = gtsam.NavState(gtsam.Pose3(poses[0]), speed[0])
    end = measured.predict(start, gtsam.imuBias.ConstantBias())
    np.testing.assert_allclose(end.pose().matrix(), poses[-1], atol=1e-6)
    np.testing.assert_allclose(end.velocity(), speed[-1], atol=1e-6)


def test_white_noise_and_random_walk_are_those_of_the_options() -> None:
    """Per root hertz: halving the time between samples makes each sample noisier, and each step of the bias smaller."""
    rng = np.random.default_rng(4)
    options = Options(
        accelerometer_density=0.02, gyroscope_density=0.003, accelerometer_walk=0.01, gyroscope_walk=0.002
    )
    for dt in (0.01, 0.005):
        bias, white = erring(40_000, dt, options, rng)
        np.testing.assert_allclose(white.std(axis=0) * np.sqrt(dt), [0.02] * 3 + [0.003] * 3, rtol=0.03)
        steps = np.diff(bias, axis=0)
        np.testing.assert_allclose(steps.std(axis=0) / np.sqrt(dt), [0.01] * 3 + [0.002] * 3, rtol=0.03)


def test_a_bag_of_the_simulation_holds_what_its_measurements_say() -> None:
    """The short way through the bytes and the long one read the same."""
    made = simulate("spiral", 2, FLIGHT)
    told = [item for item in made.measurements if isinstance(item, ImuSample)]
    records = [record for record in made.records if record.topic == "/imu"]
    assert len(told) == len(records) == 59 * 50
    store = typestore_of(())
    decoder = Decoder(store, {"/imu": ("imu", "imu")})
    from slam_backend.core.sensors.imu import decode

    for record, item in list(zip(records, told, strict=True))[::500]:
        (short,) = decoder.decode(record)
        long = decode(store.deserialize_cdr(record.data, record.type), "imu")
        for found in (short, long):
            assert (found.stamp, found.frame) == (item.stamp, item.frame)
            np.testing.assert_array_equal(found.rate, item.rate)
            np.testing.assert_array_equal(found.acceleration, item.acceleration)
            assert not found.rate_covariance.any()
            assert not found.acceleration_covariance.any()


def test_an_imu_slower_than_the_poses_is_refused() -> None:
    with pytest.raises(BadConfig, match="imu_rate"):
        Options(period=0.1, imu_rate=5)
