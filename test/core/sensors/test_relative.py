"""Loop closures: two stamps, two sensors, one factor that fits the truth with the noise it states."""

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import RelativeSource
from slam_backend.core.context import Unusable
from slam_backend.core.errors import BadMessage
from slam_backend.core.graph import Offer
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.relative import RelativePose, decode_odometry, decode_points, factors, step

ENDS = pytest.mark.parametrize(
    "ends",
    [(2 * SECOND, 11 * SECOND), (3 * SECOND, 10 * SECOND), (11 * SECOND, 5 * SECOND)],
    ids=["keyframes", "between", "back"],
)
FRAMES = pytest.mark.parametrize(
    "frames", [("", ""), ("mast", ""), ("mast", "mast")], ids=["bases", "one", "both"]
)
ROS_SIGMAS = np.array([0.03, 0.01, 0.02, 0.004, 0.012, 0.008])


def ros_error(space, pose, error):
    """A pose with an error as ROS means it: about and along the fixed axes of the parent."""
    if space.name == "2d":
        return gtsam.Pose2(pose.x() + error[0], pose.y() + error[1], pose.theta() + error[5])
    return gtsam.Pose3(gtsam.Rot3.Expmap(error[3:]) * pose.rotation(), pose.translation() + error[:3])


def measured(world, ends, frames, covariance, rng=None) -> RelativePose:
    """True, or with noise in the measurement and in the motion at both ends."""
    there = [
        (world.track.pose(stamp) if rng is None else world.wrongly(rng, stamp)).compose(
            world.mounts.get(frame)
        )
        for stamp, frame in zip(ends, frames, strict=True)
    ]
    pose = there[0].between(there[1])
    if rng is not None:
        pose = ros_error(world.space, pose, rng.multivariate_normal(np.zeros(6), covariance))
    return RelativePose(
        max(ends), "loops", *ends, *frames, frozen(world.space.seven(pose)), frozen(np.ravel(covariance))
    )


@ENDS
@FRAMES
def test_a_true_measurement_has_no_error_at_the_truth(world, offered, ends, frames):
    seen = measured(world, ends, frames, np.diag(ROS_SIGMAS**2))
    (made,) = factors(offered(seen), None, None, world.context(), RelativeSource()).add
    assert made.keys == tuple(world.place(stamp).keyframe.pose for stamp in ends)
    assert (made.kind, made.stamp, made.stamps) == ("loop", max(ends), ends)
    assert made.factor.error(world.values()) < 1e-12


@ENDS
@FRAMES
def test_the_noise_is_that_of_the_measurement_and_of_both_motions(
    world, offered, agree, spread, ends, frames
):
    """Whitened by their own noise, errors at the truth are standard normal."""
    rng = np.random.default_rng(1)
    covariance = spread(rng, ROS_SIGMAS)
    context, values, errors = world.context(), world.values(), []
    for _ in range(1_500):
        seen = measured(world, ends, frames, covariance, rng)
        (made,) = factors(offered(seen), None, None, context, RelativeSource()).add
        errors.append(made.factor.whitenedError(values))
    agree(errors)


def test_the_edge_of_a_graph_file_is_the_native_factor_to_the_bit(world, offered, spread):
    """Keyframes at both stamps, no extrinsics: the file's information goes in untouched."""
    rng, space = np.random.default_rng(2), world.space
    information = np.linalg.inv(spread(rng, np.full(space.dimension, 0.1)))
    ends = 2 * SECOND, 6 * SECOND
    seen = replace(
        measured(world, ends, ("", ""), np.diag(ROS_SIGMAS**2), rng), information=frozen(information)
    )
    (made,) = factors(offered(seen), None, None, world.context(), RelativeSource()).add
    native = space.between(
        *made.keys, space.pose(seen.pose.tolist()), gtsam.noiseModel.Gaussian.Information(information)
    )
    assert made.factor.error(world.values()) == native.error(world.values())
    assert made.factor.equals(native, 0.0)


@pytest.mark.parametrize("size", [3, 6])
def test_information_holds_for_sensors_and_between_keyframes_too(world, offered, agree, spread, size):
    """The same noise said as information, in whatever dimension the file has, or as covariance."""
    space, ends = world.space, (3 * SECOND, 10 * SECOND)
    rng = np.random.default_rng(3)
    information = frozen(np.linalg.inv(spread(rng, np.full(size, 0.01))))
    covariance = np.linalg.inv(space.information(information))
    context, values, errors = world.context(), world.values(), []
    for _ in range(1_500):
        there = [world.wrongly(rng, stamp).compose(world.mounts.get("mast")) for stamp in ends]
        error = space.expmap(rng.multivariate_normal(np.zeros(space.dimension), covariance))
        pose = there[0].between(there[1]).compose(error)
        seen = RelativePose(
            1, "loops", *ends, "mast", "mast", frozen(space.seven(pose)), frozen(np.zeros(36)), information
        )
        (made,) = factors(offered(seen), None, None, context, RelativeSource()).add
        errors.append(made.factor.whitenedError(values))
    agree(errors)


def noise_of(world, offered, covariance, yaw=0.0) -> np.ndarray:
    """The covariance at the tangent that a stated one ends as, for a pose with that yaw."""
    ends = 2 * SECOND, 11 * SECOND
    pose = frozen(world.space.seven(world.space.from_extrinsics((1, 0, 0, 0, 0, yaw))))
    seen = replace(measured(world, ends, ("", ""), covariance), pose=pose)
    config = RelativeSource(sigma_translation=0.3, sigma_rotation=0.2)
    (made,) = factors(offered(seen), None, None, world.context(), config).add
    root = made.factor.noiseModel().R()
    return np.linalg.inv(root.T @ root)


def test_zeros_mean_the_configured_default(world, offered):
    expected = world.space.diagonal(0.2**2, 0.3**2)
    np.testing.assert_allclose(noise_of(world, offered, np.zeros((6, 6))), expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 0.8, np.pi / 2])
def test_a_zero_variance_takes_its_default_on_its_own_axis_whatever_the_pose(world, offered, yaw):
    """The axes are those of the message: turned first, a zero would hide as a singular matrix."""
    stated = np.diag([0.0, 0.01, 0.01, 0.01, 0.01, 0.02])
    complete = stated + np.diag([0.3**2, 0, 0, 0, 0, 0])
    got = noise_of(world, offered, stated, yaw)
    np.testing.assert_allclose(got, noise_of(world, offered, complete, yaw), rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(got)[0] > 1e-3


def test_what_cannot_be_used_becomes_a_decision_with_both_stamps(world, offered):
    good = measured(world, (2 * SECOND, 11 * SECOND), ("", ""), np.diag(ROS_SIGMAS**2))
    near = 6 * SECOND, 6 * SECOND + 1
    bad = [
        replace(good, stamp_i=90 * SECOND),
        replace(good, frame_j="tail"),
        replace(good, stamp_i=near[0], stamp_j=near[1]),
    ]
    delta = factors(offered(*bad), None, None, world.context(), RelativeSource())
    assert [(d.stage, d.reason, d.ends) for d in delta.decisions] == [
        ("relative", "uncovered", (90 * SECOND, 11 * SECOND)),
        ("relative", "unknown_frame", (2 * SECOND, 11 * SECOND)),
        ("relative", "one_keyframe", near),
    ]


def test_the_edge_that_made_a_keyframe_is_motion(world):
    seen = measured(world, (2 * SECOND, 6 * SECOND), ("", ""), np.diag(ROS_SIGMAS**2))
    (made,) = factors([Offer("x/1/0", seen, motion=True)], None, None, world.context(), RelativeSource()).add
    assert (made.id, made.kind) == ("x/1/0", "motion")


def test_the_kernel_is_around_measured_and_around_stated_noise(world, offered):
    seen = measured(world, (2 * SECOND, 11 * SECOND), ("", ""), np.diag(ROS_SIGMAS**2))
    stated = replace(seen, information=frozen(np.eye(world.space.dimension)))
    made = factors(offered(seen, stated), None, None, world.context(), RelativeSource(kernel="dcs")).add
    assert all(isinstance(each.factor.noiseModel(), gtsam.noiseModel.Robust) for each in made)


@FRAMES
def test_a_step_is_between_the_bases(world, frames):
    seen = measured(world, (3 * SECOND, 10 * SECOND), frames, np.diag(ROS_SIGMAS**2))
    expected = world.track.motion(3 * SECOND, 10 * SECOND).pose
    assert step(seen, world.context()).equals(expected, 1e-9)
    with pytest.raises(Unusable):
        step(replace(seen, frame_i="tail"), world.context())


# -- messages ----------------------------------------------------------------------------------------------------


def odometry(frame, child, stamp=(9, 0)) -> SimpleNamespace:
    point = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    pose = SimpleNamespace(position=point, orientation=SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]), frame_id=frame)
    covariance = np.arange(36.0)
    return SimpleNamespace(
        header=header, child_frame_id=child, pose=SimpleNamespace(pose=pose, covariance=covariance)
    )


def test_the_frames_of_an_odometry_say_when_both_ends_were():
    told = decode_odometry(odometry("/mast@3.5", "base@4.000000001"), "loops")
    assert (told.frame_i, told.frame_j) == ("mast", "base")
    assert told.ends == (3_500_000_000, 4_000_000_001)
    assert told.stamp == 9 * SECOND
    np.testing.assert_array_equal(told.pose, [1, 2, 3, 0, 0, 0.6, 0.8])
    np.testing.assert_array_equal(told.covariance, np.arange(36))
    assert told.information is None


def test_a_relative_pose_applies_when_both_its_ends_are_known():
    assert decode_odometry(odometry("a@3", "b@12"), "loops").stamp == 12 * SECOND


@pytest.mark.parametrize(
    ("frame", "child"),
    [("base", "base@4"), ("base@3", "base"), ("base@x", "base@4"), ("a@1.1234567890", "b@2")],
)
def test_frames_without_a_stamp_are_one_clear_line(frame, child):
    with pytest.raises(BadMessage, match=r"stamp|when"):
        decode_odometry(odometry(frame, child), "loops")


POINTS = {
    "stamp_i_sec": [3, 4], "stamp_i_nsec": [5, 6], "stamp_j_sec": [13, 14], "stamp_j_nsec": [15, 16],
    "x": [1, 2], "y": [3, 4], "z": [5, 6], "qx": [0, 0], "qy": [0, 0], "qz": [0, 0.6], "qw": [1, 0.8],
}  # fmt: skip


def cloud(**columns) -> SimpleNamespace:
    """A PointCloud2 with one float64 field per column; a column may hold vectors."""
    fields, parts, offset = [], [], 0
    for name, column in columns.items():
        array = np.asarray(column, dtype=np.float64)
        count = array.shape[1] if array.ndim > 1 else 1
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=8, count=count))
        parts.append(array.reshape(len(array), count))
        offset += 8 * count
    table = np.hstack(parts)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="mast")
    return SimpleNamespace(
        header=header, width=len(table), height=1, point_step=offset, fields=fields, is_bigendian=False,
        data=table.tobytes(),
    )  # fmt: skip


def test_a_cloud_is_a_batch_of_relative_poses():
    first, second = decode_points(cloud(**POINTS), "loops")
    assert first.ends == (3 * SECOND + 5, 13 * SECOND + 15)
    assert second.stamp == 14 * SECOND + 16
    assert (first.frame_i, first.frame_j) == ("mast", "mast")
    np.testing.assert_array_equal(second.pose, [2, 4, 6, 0, 0, 0.6, 0.8])
    assert not first.covariance.any()


def test_noise_of_a_cloud_is_a_covariance_or_sigmas_the_nearest_name_first():
    (full, _) = decode_points(cloud(**POINTS, cov=[np.arange(36), np.arange(36)]), "loops")
    np.testing.assert_array_equal(full.covariance, np.arange(36))
    sigmas = {"sigma_translation": [0.1, 0.1], "sigma_rotation": [0.2, 0.2], "sigma_yaw": [0.3, 0.3]}
    (said, _) = decode_points(cloud(**POINTS, **sigmas), "loops")
    np.testing.assert_allclose(np.diag(said.covariance.reshape(6, 6)), [0.01, 0.01, 0.01, 0.04, 0.04, 0.09])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"qw": None}, "'qw'"),
        ({"stamp_j_nsec": None}, "'stamp_j_nsec'"),
        ({"x": [[1, 2], [3, 4]]}, "'x' holds 2 numbers"),
        ({"stamp_i_sec": [[1, 2], [3, 4]]}, "'stamp_i_sec' holds 2 numbers"),
        ({"stamp_i_sec": [np.nan, 1]}, "stamp"),
        ({"cov": [[1, 2], [3, 4]]}, "36 are needed"),
    ],
)
def test_a_cloud_that_cannot_be_understood_is_one_clear_line(change, text):
    columns = {name: column for name, column in {**POINTS, **change}.items() if column is not None}
    with pytest.raises(BadMessage, match=text):
        list(decode_points(cloud(**columns), "loops"))
