"""Sightings of tags, landmarks with an orientation: factors that fit the truth with the noise they state."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam_backend.core.config import LandmarkSource
from slam_backend.core.graph import UNTIL_JOINED, landmark_key, tag_key
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.mounts import Mounts
from slam_backend.core.sensors.landmark import LandmarkObservation, factors

AT_KEYFRAME, AFTER, BEFORE = 6 * SECOND, 7 * SECOND + SECOND // 3, 5 * SECOND - SECOND // 7
STAMPS = pytest.mark.parametrize("stamp", [AT_KEYFRAME, AFTER, BEFORE], ids=["at", "after", "before"])
FRAMES = pytest.mark.parametrize("frame", ["", "mast"], ids=["base", "mast"])
SIGMAS = [0.01, 0.03, 0.02, 0.004, 0.006, 0.005]
KEY = tag_key(7)
SOURCE = LandmarkSource()


def place_of(world):
    return world.space.from_extrinsics((6.0, 2.0, 1.5, 0.3, -0.2, 2.0))


def context_of(world, known=True, part=0):
    """known: whether the tag is in the graph already."""
    return replace(
        world.context(),
        tag=lambda _: KEY,
        landmark=lambda _: KEY,
        component=lambda key: world.component(key) if key != KEY else part if known else None,
    )


def values_of(world) -> gtsam.Values:
    values = world.values()
    values.insert(KEY, place_of(world))
    return values


def sighting(world, frame, stamp, covariance, rng=None) -> LandmarkObservation:
    """True, or with noise in the sensor (about the fixed axes of its frame) and in the motion since the keyframe."""
    space = world.space
    base = world.track.pose(stamp) if rng is None else world.wrongly(rng, stamp)
    tag = base.compose(world.mounts.get(frame)).inverse().compose(place_of(world))
    if rng is not None:
        tag = tag.compose(
            space.expmap(
                rng.multivariate_normal(np.zeros(space.dimension), space.covariance(covariance.ravel(), tag))
            )
        )
    value = frozen(space.seven(tag))
    return LandmarkObservation(stamp, "tags", frame, "tag36h11:5", "pose", value, frozen(covariance))


@FRAMES
@STAMPS
def test_a_true_sighting_has_no_error_at_the_truth(world, offered, frame, stamp):
    seen = sighting(world, frame, stamp, np.zeros((6, 6)))
    (made,) = factors(offered(seen), None, None, context_of(world), SOURCE).add
    assert made.keys == (world.place(stamp).keyframe.pose, KEY)
    assert (made.kind, made.source, made.stamp) == ("landmark", "tags", stamp)
    assert made.factor.error(values_of(world)) < 1e-12


@FRAMES
@STAMPS
def test_the_noise_is_that_of_the_sighting_and_of_the_motion(world, offered, agree, spread, frame, stamp):
    """Whitened by their own noise, errors at the truth are standard normal."""
    rng = np.random.default_rng(1)
    covariance, context, values = spread(rng, SIGMAS), context_of(world), values_of(world)
    errors = []
    for _ in range(1_000):
        seen = sighting(world, frame, stamp, covariance, rng)
        (made,) = factors(offered(seen), None, None, context, SOURCE).add
        errors.append(made.factor.whitenedError(values))
    agree(errors)


def test_from_the_keyframe_itself_it_is_the_native_factor_with_the_same_jacobians(world, offered, spread):
    rng, space = np.random.default_rng(2), world.space
    covariance = spread(rng, SIGMAS)
    seen = sighting(world, "", AT_KEYFRAME, covariance, rng)
    (made,) = factors(offered(seen), None, None, context_of(world), SOURCE).add
    tag = space.pose(seen.value.tolist())
    noise = gtsam.noiseModel.Gaussian.Covariance(space.covariance(covariance.ravel(), tag))
    native = space.between(*made.keys, tag, noise)
    assert made.factor.equals(native, 1e-9)
    mine, theirs = (each.linearize(values_of(world)).jacobian()[0] for each in (made.factor, native))
    np.testing.assert_allclose(mine, theirs, atol=1e-9)


@FRAMES
def test_a_new_tag_starts_where_it_is_first_seen(world, offered, frame):
    first, second = (sighting(world, frame, stamp, np.zeros((6, 6))) for stamp in (AFTER, BEFORE))
    delta = factors(offered(first, second), None, None, context_of(world, known=False), SOURCE)
    assert list(delta.values) == [KEY]
    assert delta.values[KEY].equals(place_of(world), 1e-9)
    assert len(delta.add) == 2


def test_noise_that_is_not_stated_is_the_configured_one(world, offered):
    config = LandmarkSource(sigma_position=0.3, sigma_rotation=0.2)
    seen = sighting(world, "mast", AT_KEYFRAME, np.zeros((6, 6)))
    stated = np.diag(np.square([0.3] * 3 + [0.2] * 3))
    same = replace(seen, covariance=frozen(stated))
    made = factors(offered(seen, same), None, None, context_of(world), config).add
    default, explicit = (each.factor.noiseModel().R() for each in made)
    np.testing.assert_allclose(default, explicit, rtol=1e-9)


def test_a_tag_of_another_part_waits_and_says_where_it_was_seen(world, offered):
    seen = sighting(world, "mast", AFTER, np.zeros((6, 6)))
    (wait,) = factors(offered(seen), None, None, context_of(world, part=7), SOURCE).waits
    assert wait.until == UNTIL_JOINED
    assert world.pose(wait.seen.pose).compose(wait.seen.point).equals(place_of(world), 1e-9)


def test_in_the_plane_a_camera_with_an_optical_frame_tells_the_yaw_of_a_tag(world, offered):
    """A tag on a wall 5 m ahead, 1 m to the right, its x axis level: in either space it stands where it does."""
    optical = {"camera": (0.3, 0.0, 0.6, -np.pi / 2, 0.0, -np.pi / 2)}
    context = replace(context_of(world, known=False), mounts=Mounts(world.space, "base_link", optical))
    lens = gtsam.Pose3(gtsam.Rot3.RzRyRx(*optical["camera"][3:]), np.array(optical["camera"][:3]))
    on_wall = gtsam.Pose3(gtsam.Rot3.RzRyRx(-np.pi / 2, 0.0, 0.4), np.array([5.3, -1.0, 0.4]))
    camera_T_tag = lens.inverse().compose(on_wall)
    q = camera_T_tag.rotation().toQuaternion()
    value = frozen([*camera_T_tag.translation(), q.x(), q.y(), q.z(), q.w()])
    unlike = np.diag([0.01, 0.02, 0.05, 0.1, 0.2, 0.3]) ** 2  # z of the camera is ahead, its y is down
    seen = LandmarkObservation(AT_KEYFRAME, "tags", "camera", "t:5", "pose", value, frozen(unlike))
    (made,) = factors(offered(seen), None, None, context, SOURCE).add
    if world.space.name == "3d":
        assert made.factor.measured().equals(on_wall, 1e-9)
        return
    assert made.factor.measured().equals(gtsam.Pose2(5.3, -1.0, 0.4), 1e-9)
    turn = gtsam.Rot2(-0.4).matrix()
    np.testing.assert_allclose(
        made.factor.noiseModel().covariance(),
        np.block([[turn @ np.diag([0.05, 0.01]) ** 2 @ turn.T, np.zeros((2, 1))], [np.zeros(2), 0.2**2]]),
        atol=1e-12,
    )


def test_a_tag_that_hangs_askew_has_no_yaw_in_the_plane(world, offered):
    """Its x axis points up: in the plane that is refused, in space it is a pose like any other."""
    seen = sighting(world, "", AT_KEYFRAME, np.zeros((6, 6)))
    askew = frozen([5.0, 0.0, 0.0, 0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    delta = factors(offered(replace(seen, value=askew)), None, None, context_of(world), SOURCE)
    if world.space.name == "3d":
        assert len(delta.add) == 1
    else:
        assert [(d.verdict, d.stage, d.reason) for d in delta.decisions] == [("refused", "landmark", "steep")]


def test_without_its_orientation_a_tag_is_a_point(world, offered):
    """By the setting, or because the name is that of a point already."""
    oak = landmark_key(0)
    as_point = replace(context_of(world), tag=lambda _: oak, landmark=lambda _: oak)
    seen = sighting(world, "mast", AFTER, np.zeros((6, 6)))
    alike = replace(seen, form="position", value=seen.value[:3], covariance=frozen(np.zeros((3, 3))))
    for context, config in ((as_point, SOURCE), (as_point, LandmarkSource(orientation=False))):
        pose, position = factors(offered(seen, alike), None, None, context, config).add
        assert pose.keys[1] == oak
        assert pose.factor.equals(position.factor, 1e-12)


def test_a_tag_that_is_known_by_its_orientation_is_not_seen_without(world, offered):
    seen = sighting(world, "", AT_KEYFRAME, np.zeros((6, 6)))
    bare = replace(seen, form="range", value=frozen([2.0]), covariance=frozen([[0.01]]))
    delta = factors(offered(bare), None, None, context_of(world), SOURCE)
    assert [(d.verdict, d.reason) for d in delta.decisions] == [("refused", "orientation")]
