"""Fixes on the earth: what the messages say, factors that fit the truth with their noise, and a yaw that is found from the path."""

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pymap3d
import pytest

from slam_backend.core.config import Earth, GnssSource
from slam_backend.core.graph import EARTH, UNTIL_JOINED, Wait
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix, decode, factors, stated

ORIGIN = (42.3758, -71.1474, 12.0)
AT_KEYFRAME, AFTER, BEFORE = 6 * SECOND, 7 * SECOND + SECOND // 3, 5 * SECOND - SECOND // 7
STAMPS = pytest.mark.parametrize("stamp", [AT_KEYFRAME, AFTER, BEFORE], ids=["at", "after", "before"])
FRAMES = pytest.mark.parametrize("frame", ["", "mast"], ids=["base", "mast"])
SIGMAS = (0.4, 0.7, 1.1)


def earth_of(world):
    """map_T_earth: turned by 2 rad and, where it can be, leaning."""
    return world.space.from_extrinsics((30.0, -12.0, 4.0, 0.06, -0.05, 2.0))


def context_of(world, turned=0.0, **more):
    """The earth is known, but for an angle in each axis of rotation that the space has."""
    off = world.space.expmap(np.sqrt(np.diag(world.space.diagonal(turned**2, 0.0))))
    return replace(world.context(), guesses={EARTH: earth_of(world).compose(off)}, origin=ORIGIN, **more)


def fix(world, frame, stamp, covariance=None, rng=None) -> Fix:
    """True, or with noise of its own and of the motion since the keyframe."""
    base = world.track.pose(stamp) if rng is None else world.wrongly(rng, stamp)
    antenna = earth_of(world).transformTo(base.transformFrom(world.mounts.get(frame).translation()))
    enu = np.append(antenna, np.zeros(3 - len(antenna)))
    covariance = np.diag(np.square(SIGMAS)) if covariance is None else covariance
    if rng is not None:
        enu = enu + rng.multivariate_normal(np.zeros(3), covariance)
    place = pymap3d.enu2geodetic(*enu, *ORIGIN)
    return Fix(stamp, "gps", frame, frozen(place), frozen(covariance))


def values_of(world):
    values = world.values()
    values.insert(EARTH, earth_of(world))
    return values


@FRAMES
@STAMPS
@pytest.mark.parametrize("turned", [0.0, 0.1])
def test_a_true_fix_has_no_error_at_the_truth_however_the_first_guess_was_turned(
    world, offered, frame, stamp, turned
):
    seen = fix(world, frame, stamp)
    (made,) = factors(
        offered(seen), None, world.timeline.keyframes[1], context_of(world, turned), GnssSource()
    ).add
    assert made.keys == (world.place(stamp).keyframe.pose, EARTH)
    assert (made.kind, made.source, made.stamp) == ("gnss", "gps", stamp)
    assert made.factor.error(values_of(world)) < 1e-9


@FRAMES
@STAMPS
def test_the_noise_is_that_of_the_fix_and_of_the_motion(world, offered, agree, spread, frame, stamp):
    """Whitened by their own noise, errors at the truth are standard normal."""
    rng = np.random.default_rng(1)
    covariance, context, values = spread(rng, SIGMAS), context_of(world), values_of(world)
    errors = []
    for _ in range(1_500):
        seen = fix(world, frame, stamp, covariance, rng)
        (made,) = factors(offered(seen), None, world.timeline.keyframes[1], context, GnssSource()).add
        errors.append(made.factor.whitenedError(values)[: world.space.point_dimension])
    agree(errors)


def test_its_derivative_is_that_of_its_error(world, offered):
    """Central differences, away from the truth and from the guess."""
    rng, size = np.random.default_rng(3), world.space.dimension
    seen = fix(world, "mast", AFTER, rng=rng)
    (made,) = factors(
        offered(seen), None, world.timeline.keyframes[1], context_of(world, 0.1), GnssSource()
    ).add
    factor, values = made.factor, gtsam.Values()
    for key in made.keys:
        values.insert(key, values_of_pose(world, key).compose(world.space.expmap(rng.normal(0, 0.1, size))))
    stated = factor.linearize(values).jacobian()[0]
    found = []
    for key in made.keys[::-1]:
        for axis in range(size):
            steps = []
            for sign in (1, -1):
                moved = gtsam.Values(values)
                pose = world.space.pose_in(values, key)
                moved.update(key, pose.compose(world.space.expmap(sign * 1e-5 * np.eye(size)[axis])))
                steps.append(factor.whitenedError(moved))
            found.append((steps[0] - steps[1]) / 2e-5)
    np.testing.assert_allclose(stated, np.array(found).T, atol=1e-6)


def values_of_pose(world, key):
    return earth_of(world) if key == EARTH else world.pose(key)


def test_with_the_earth_at_hand_its_cost_is_that_of_the_native_factor_with_an_arm(world, offered):
    """gtsam has one for 3-D only; the guess may be off by a few degrees."""
    if world.space.name == "2d":
        pytest.skip("there is no native factor with an arm in the plane")
    rng, size = np.random.default_rng(4), world.space.dimension
    seen = fix(world, "mast", AT_KEYFRAME, rng=rng)
    (made,) = factors(
        offered(seen), None, world.timeline.keyframes[1], context_of(world, 0.03), GnssSource()
    ).add
    key = made.keys[0]
    enu = np.array(pymap3d.geodetic2enu(*seen.place, *ORIGIN))
    noise = gtsam.noiseModel.Gaussian.Covariance(seen.covariance)
    native = gtsam.GPSFactorArm(key, enu, world.mounts.get("mast").translation(), noise)
    at = gtsam.Values()
    at.insert(
        key, earth_of(world).between(world.pose(key)).compose(world.space.expmap(rng.normal(0, 0.02, size)))
    )
    values = gtsam.Values(at)
    values.update(key, earth_of(world).compose(at.atPose3(key)))
    values.insert(EARTH, earth_of(world))
    assert made.factor.error(values) == pytest.approx(native.error(at), rel=0.02)


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
def test_a_covariance_means_what_its_type_says(kind):
    """Unknown: the default; diagonal: nothing beside the diagonal; approximated and known: as it stands."""
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 25.0]])
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=7), frame_id="/antenna"),
        latitude=1.0, longitude=2.0, altitude=3.0, status=SimpleNamespace(status=-1),
        position_covariance=covariance.reshape(9), position_covariance_type=kind,
    )  # fmt: skip
    found = decode(message, "gps")
    assert (found.stamp, found.frame, found.status) == (3 * SECOND + 7, "antenna", -1)
    assert found.place.tolist() == [1.0, 2.0, 3.0]
    expected = {0: np.zeros((3, 3)), 2: np.diag([4.0, 9.0, 25.0])}.get(kind, covariance)
    np.testing.assert_array_equal(found.covariance, expected)


def test_what_is_not_stated_takes_the_default_and_none_is_surer_than_the_floor():
    given = np.array([[4.0, 0.5, 0.0], [0.5, 1e-9, 0.0], [0.0, 0.0, np.nan]])
    config = GnssSource(sigma_vertical=7.0, sigma_floor=0.1)
    found = stated(Fix(SECOND, "gps", "", np.zeros(3), given), config)
    np.testing.assert_allclose(found, [[4.0, 0.5, 0.0], [0.5, 0.01, 0.0], [0.0, 0.0, 49.0]])


def waiting_of(world, *seen, **settings):
    """What the sensor makes of fixes before the earth has a place."""
    return replace(
        world.context(), origin=ORIGIN, waiting=lambda key: [Wait(offer, key, "") for offer in seen], earth=Earth(**settings),
        component=lambda key: None if key == EARTH else 0,
    )  # fmt: skip


def test_until_the_fixes_reach_far_enough_they_wait_and_say_why(world, offered):
    (seen,) = offered(fix(world, "", AT_KEYFRAME))
    delta = factors([seen], None, world.timeline.keyframes[1], waiting_of(world), GnssSource())
    assert not delta.add
    assert not delta.values
    (wait,) = delta.waits
    assert wait.until == EARTH
    assert wait.reason.startswith("yaw not yet observable: the fixes reach over 0.0 m, and 5.0 m")


def test_the_first_guess_lays_the_fixes_onto_the_odometry(world, offered):
    """Within the leaning of the earth, which only the graph can find; one wrong fix in nine does not matter."""
    stamps = [(2 + n) * SECOND for n in range(9)]
    fixes = [fix(world, "mast", stamp, np.eye(3) * 1e-4) for stamp in stamps]
    wrong = frozen(fixes[4].place + np.array([3e-4, 0.0, 0.0]))  # 33 m north
    held = offered(*fixes[:4], replace(fixes[4], place=wrong), *fixes[5:])
    context = waiting_of(world, *held[:-1], baseline=1.0)
    delta = factors(held[-1:], None, world.timeline.keyframes[2], context, GnssSource())
    assert [factor.kind for factor in delta.add] == ["earth", "gnss"]
    assert all(factor.keys == (world.timeline.keyframes[2].pose, EARTH) for factor in delta.add)
    here = world.pose(world.timeline.keyframes[2].pose)
    expected, found = (earth.between(here) for earth in (earth_of(world), delta.values[EARTH]))
    meters, radians = world.space.size(expected.between(found))
    assert radians < 0.12
    assert meters < 0.3


def test_a_yaw_that_is_given_needs_no_path(world, offered):
    (seen,) = offered(fix(world, "mast", AT_KEYFRAME))
    context = waiting_of(world, yaw=-2.0)
    delta = factors([seen], None, world.timeline.keyframes[1], context, GnssSource())
    assert world.space.size(earth_of(world).between(delta.values[EARTH]))[1] < 0.1
    assert len(delta.add) == 2


def test_a_fix_on_a_part_that_the_earth_does_not_belong_to_waits_until_they_are_joined(world, offered):
    world.parts[EARTH] = 7
    context = replace(
        world.context(), origin=ORIGIN, estimate=SimpleNamespace(pose=lambda key: values_of_pose(world, key))
    )
    delta = factors(
        offered(fix(world, "", AT_KEYFRAME)), None, world.timeline.keyframes[1], context, GnssSource()
    )
    assert [wait.until for wait in delta.waits] == [UNTIL_JOINED]


def test_an_antenna_that_nobody_mounted_makes_no_factor(world, offered):
    seen = replace(fix(world, "", AT_KEYFRAME), frame="roof")
    delta = factors(offered(seen), None, world.timeline.keyframes[1], context_of(world), GnssSource())
    assert [(d.stage, d.reason) for d in delta.decisions] == [("gnss", "unknown_frame")]
