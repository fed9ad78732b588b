"""The firewall: nothing kills, what is refused is named, and only what the configuration uses is judged."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.check import checked, rechecked
from slam_backend.core.config import Config, LandmarkSource, OdometrySource, PoseSource, RelativeSource
from slam_backend.core.firewall.rules import ACCELERATION
from slam_backend.core.graph import Decision
from slam_backend.core.keyframes import Track
from slam_backend.core.measurement import SECOND, Measurement, StaticTransform, frozen
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import HERE, STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.space import SPACES

GOOD = np.diag([0.04, 0.09, 0.01, 0.02, 0.03, 0.05])
DIMENSIONS = pytest.mark.parametrize("space", ["2d", "3d"])


def config(space="3d", noise="model", **settings) -> Config:
    sources = {
        "wheels": OdometrySource(noise=noise, **settings),
        "loops": RelativeSource(),
        "tags": LandmarkSource(),
        "amcl": PoseSource(),
    }
    return Config(space=space, sources=sources)


def wheels(stamp=SECOND, pose=HERE, covariance=GOOD, twist_covariance=GOOD) -> OdometryPose:
    covariances = frozen(np.ravel(covariance)), frozen(np.ravel(twist_covariance))
    return OdometryPose(stamp, "wheels", "odom", "base", frozen(pose), covariances[0], STILL, covariances[1])


def loop(covariance=GOOD, pose=HERE, stamps=(SECOND, 2 * SECOND), information=None) -> RelativePose:
    return RelativePose(
        max(stamps), "loops", *stamps, "", "", frozen(pose), frozen(np.ravel(covariance)),
        None if information is None else frozen(information),
    )  # fmt: skip


def localized(covariance=GOOD, pose=HERE, stamp=SECOND) -> AbsolutePose:
    return AbsolutePose(stamp, "amcl", "", frozen(pose), frozen(np.ravel(covariance)))


def sighted(form="position", value=(1.0, 2.0, 3.0), covariance=None, stamp=SECOND) -> LandmarkObservation:
    covariance = np.diag([0.1] * len(value)) if covariance is None else covariance
    return LandmarkObservation(stamp, "tags", "", "7", form, frozen(value), frozen(covariance))


def verdict(item, settings=None) -> str:
    """The rule that refused a measurement, or `kept` and what was noted about it."""
    out = list(checked([item], settings or config()))
    told = [f"{d.verdict} {d.stage}/{d.reason}" for d in out if isinstance(d, Decision)]
    if item in out:
        return " ".join(["kept", *told])
    (refused,) = told
    return refused.removeprefix("refused check/")


def entry(k, j, value) -> np.ndarray:
    changed = GOOD.copy()
    changed[k, j] = value
    return changed


# -- stamps and poses --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("item", [wheels(), loop(), localized(), sighted()], ids=lambda item: item.source)
def test_what_is_right_is_kept_and_a_stamp_of_zero_is_refused(item):
    assert verdict(item) == "kept"
    assert verdict(replace(item, stamp=0)) == "zero_stamp"
    assert verdict(replace(item, stamp=-5)) == "zero_stamp"


@pytest.mark.parametrize("stamps", [(0, SECOND), (SECOND, 0)])
def test_a_relative_pose_needs_both_stamps(stamps):
    assert verdict(loop(stamps=stamps)) == "zero_stamp"


@pytest.mark.parametrize("stamps", [(SECOND, 1 << 61), (10**300, SECOND)])
def test_a_stamp_that_no_header_can_say_is_refused(stamps):
    assert verdict(loop(stamps=stamps)) == "far_stamp"


@DIMENSIONS
@pytest.mark.parametrize("make", [wheels, loop, localized])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, 1.1e9])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_pose_without_finite_position_is_refused(space, make, value, axis):
    pose = list(HERE)
    pose[axis] = value
    assert verdict(make(pose=pose), config(space)) == "not_finite"


@DIMENSIONS
@pytest.mark.parametrize(
    ("quaternion", "rule"),
    [
        ((0, 0, 0, 0), "quaternion"),
        ((0, 0, 0, 1.2), "quaternion"),
        ((0, 0, 0, 1e308), "not_finite"),
        ((np.nan, 0, 0, 1), "not_finite"),
        ((0, 0, 0, 1.02), "kept"),
        ((0, 0, 0, -1), "kept"),
    ],
)
def test_a_quaternion_must_be_nearly_of_unit_length(space, quaternion, rule):
    for make in (wheels, loop, localized):
        assert verdict(make(pose=(0, 0, 0, *quaternion)), config(space)) == rule


def test_a_decision_names_the_record_its_stamps_and_the_numbers():
    (refused,) = checked([loop(entry(1, 1, -2.0))], config())
    assert (refused.id, refused.source, refused.ends) == ("loops/2.000000000", "loops", (SECOND, 2 * SECOND))
    assert (refused.statistic, refused.threshold) == (-2.0, 0.0)


def test_what_the_firewall_does_not_know_passes():
    strange, told = Measurement(0, "nobody"), Decision(1, "x", "x", "refused", "decode", "nonsense")
    assert list(checked([strange, told], config())) == [strange, told]


@DIMENSIONS
def test_static_transforms_need_a_pose_but_neither_stamp_nor_source(space):
    def static(pose):
        return StaticTransform(0, "/tf_static", "base", "camera", frozen(pose))

    assert verdict(static(HERE), config(space)) == "kept"
    assert verdict(static((0, 0, 0, 0, 0, 0, 0)), config(space)) == "quaternion"
    assert verdict(static((np.nan, 0, 0, 0, 0, 0, 1)), config(space)) == "not_finite"


# -- covariances -------------------------------------------------------------------------------------------------

INDEFINITE = entry(0, 1, 0.07) + entry(1, 0, 0.07) - GOOD  # correlation 1.17


@pytest.mark.parametrize(
    ("covariance", "rule"),
    [
        (entry(0, 0, -1e-9), "covariance_negative"),
        (entry(0, 1, 0.01), "covariance_asymmetric"),
        (INDEFINITE, "covariance_indefinite"),
        (entry(5, 5, np.nan), "covariance_not_finite"),
        (entry(0, 1, np.nan), "covariance_not_finite"),
        (entry(1, 1, np.inf), "covariance_not_finite"),
        (np.eye(6) * 1e12, "covariance_absurd"),
        (np.eye(6) * 1e308, "covariance_absurd"),
        (np.diag([1e12, 1e12, 1, 1, 1, 1e11]), "kept"),
        (np.eye(6) * 1e-300, "covariance_tiny"),
        (entry(0, 0, 4e-323), "covariance_tiny"),  # an integer 8 in a float64 field
        (np.eye(6) * 1e-17, "kept"),
        (np.zeros((6, 6)), "kept accepted check/zero_covariance"),
        (entry(0, 0, 0.0), "kept accepted check/zero_covariance"),
        (np.diag([0, 1, 1, 1, 1, 1]) + 0.1 * (np.eye(6, k=1) + np.eye(6, k=-1)), "covariance_indefinite"),
    ],
)
@DIMENSIONS
def test_covariances_are_judged_on_the_axes_that_the_space_uses(space, covariance, rule):
    settings, twisted, posed = config(space), config(space, "twist"), config(space, "pose")
    assert verdict(loop(covariance), settings) == rule
    assert verdict(localized(covariance), settings) == rule
    assert verdict(wheels(covariance=covariance), posed) == rule
    assert verdict(wheels(twist_covariance=covariance), twisted) == rule


def test_a_variance_without_bounds_becomes_a_large_one_correlated_with_nothing():
    """Some say 'unknown' with the largest double: the other axes are still worth something."""
    given = entry(0, 0, 1e308) + entry(0, 1, 1e100) + entry(1, 0, 1e100) - 2 * GOOD
    told, kept = checked([loop(given)], config())
    assert (told.reason, told.ends) == ("covariance_capped", None)
    expected = GOOD.copy()
    expected[0, 0] = 1e12
    np.testing.assert_allclose(kept.covariance.reshape(6, 6), expected, rtol=1e-12)
    assert not kept.covariance.flags.writeable


def test_rotation_before_translation_is_noticed():
    """GTSAM's order in a planar robot's message, and a GNSS-like position in the place of the rotation."""
    planar = np.diag([0.0, 0.0, 0.03, 0.1, 0.1, 0.0])
    spatial = np.diag([0.01, 0.01, 0.02, 25.0, 25.0, 100.0])
    assert verdict(localized(planar), config("2d")) == "kept accepted check/covariance_swapped"
    assert verdict(loop(spatial), config("3d")) == "kept accepted check/covariance_swapped"
    for usual in ([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e3], [0.25, 0.25, 0, 0, 0, 0.07], [1, 1, 1, 1, 1, 1]):
        assert "swapped" not in verdict(localized(np.diag(usual)), config("3d"))


def test_only_the_covariance_that_is_used_is_judged():
    nonsense = np.full((6, 6), np.nan)
    assert verdict(wheels(covariance=nonsense, twist_covariance=nonsense)) == "kept"
    assert verdict(wheels(covariance=nonsense), config(noise="twist")) == "kept"
    assert verdict(wheels(twist_covariance=nonsense), config(noise="pose")) == "kept"


def test_real_robots_pass():
    """AMCL states zero for z, roll and pitch; turtlebot3 states 1e-5 to 1e12."""
    amcl = np.zeros((6, 6))
    amcl[np.ix_([0, 1, 5], [0, 1, 5])] = [[0.2, 0.01, 0.0], [0.01, 0.2, 0.0], [0.0, 0.0, 0.07]]
    turtlebot = np.diag([1e-5, 1e-5, 1e12, 1e12, 1e12, 1e-3])
    for covariance in (amcl, turtlebot):
        assert verdict(localized(covariance), config("2d")) == "kept"
        assert verdict(wheels(covariance=covariance), config("2d", "pose")) == "kept"
    assert verdict(wheels(covariance=turtlebot), config("3d", "pose")) == "kept"
    assert verdict(localized(amcl), config("3d")) == "kept accepted check/zero_covariance"


def test_a_default_is_said_once_per_source_and_counts_as_no_verdict_on_a_loop():
    zero = np.zeros((6, 6))
    out = list(checked([loop(zero), loop(zero), localized(zero), localized(zero)], config()))
    told = [item for item in out if isinstance(item, Decision)]
    assert [(d.source, d.verdict, d.ends) for d in told] == [
        ("loops", "accepted", None),
        ("amcl", "accepted", None),
    ]
    assert len(out) == 6


@pytest.mark.parametrize(
    ("information", "rule"),
    [
        (np.diag([1.0, 4.0, 9.0]), "kept"),
        (np.diag([1.0, 0.0, 9.0]), "information_indefinite"),
        (np.diag([1.0, -1.0, 9.0]), "information_indefinite"),
        (np.diag([1.0, np.nan, 9.0]), "information_not_finite"),
        (np.ones((3, 3)), "information_indefinite"),
    ],
)
def test_the_information_of_a_graph_file_is_judged_instead_of_the_covariance(information, rule):
    assert verdict(loop(np.full((6, 6), np.nan), information=information)) == rule


# -- a plane does not care about height, roll and pitch ----------------------------------------------------------


def unused_axes_spoilt(value) -> np.ndarray:
    spoilt = GOOD.copy()
    spoilt[2:5, :] = spoilt[:, 2:5] = value
    return spoilt


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 1e308])
def test_in_the_plane_the_unused_axes_may_hold_anything_and_the_numbers_stay_finite(value):
    space, flat = SPACES["2d"], config("2d")
    pose = (1.0, 2.0, value, 0.0, 0.0, 0.0, 1.0)
    covariance = unused_axes_spoilt(value)
    for item in (loop(covariance, pose), localized(covariance, pose)):
        assert verdict(item, flat) == "kept"
        there = space.pose(item.pose.tolist())
        assert np.isfinite(space.covariance(item.covariance, there)).all()
        assert np.isfinite(space.numbers(there)).all()
    assert verdict(wheels(pose=pose, covariance=covariance), config("2d", "pose")) == "kept"
    assert verdict(sighted(value=(1.0, 2.0, value)), flat) == "kept"
    assert verdict(sighted("bearing_range", (0.3, value, 2.0)), flat) == "kept"
    assert verdict(sighted("bearing", (0.3, value)), flat) == "kept"


def test_in_the_plane_a_restart_with_spoilt_unused_axes_stays_finite():
    settings = config("2d", "pose", max_speed=2.0)
    covariance = unused_axes_spoilt(np.nan)
    track = [wheels(n * SECOND, (n, 0, np.nan, 0, 0, 0, 1), covariance) for n in (1, 2)]
    track += [wheels(n * SECOND, (n + 50, 0, np.nan, 0, 0, 0, 1), covariance) for n in (3, 4)]
    kept = [item for item in rechecked(track, settings) if isinstance(item, Measurement)]
    assert [item.pose[0] for item in kept] == [1.0, 2.0, 3.0, 4.0]
    used = np.ix_([0, 1, 5], [0, 1, 5])
    for item in kept:
        np.testing.assert_allclose(item.covariance.reshape(6, 6)[used], GOOD[used], atol=1e-12)


# -- landmarks ---------------------------------------------------------------------------------------------------


@DIMENSIONS
@pytest.mark.parametrize(
    ("item", "rule"),
    [
        (sighted(value=(np.nan, 1, 1)), "not_finite"),
        (sighted(value=(1, 1e308, 1)), "not_finite"),
        (sighted("bearing", (np.inf, 0.0)), "not_finite"),
        (sighted("bearing_range", (0.1, 0.1, 0.0)), "range"),
        (sighted("bearing_range", (0.1, 0.1, -3.0)), "range"),
        (sighted(value=(0.0, 0.0, 0.0)), "range"),
        (sighted(covariance=np.diag([0.1, -0.1, 0.1])), "covariance_negative"),
        (sighted(covariance=np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1]])), "covariance_indefinite"),
        (sighted(covariance=np.array([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]])), "covariance_asymmetric"),
        (sighted(covariance=np.diag([np.inf, 1, 1])), "covariance_not_finite"),
        (sighted(covariance=np.eye(3) * 1e12), "covariance_absurd"),
        (sighted(covariance=np.full((3, 3), np.nan)), "kept"),
        (sighted(covariance=np.zeros((3, 3))), "kept"),
        (sighted(covariance=np.diag([np.nan, 0.1, 0.1])), "kept"),
        (sighted(covariance=np.diag([0.0, 0.1, 0.1])), "kept accepted check/zero_covariance"),
    ],
)
def test_sightings_are_judged_by_their_form(space, item, rule):
    assert verdict(item, config(space)) == rule


@pytest.mark.parametrize(
    ("spoilt", "rule"), [({"landmark": ""}, "landmark_id"), ({"form": "smell"}, "landmark_kind")]
)
def test_a_landmark_needs_a_name_and_a_form_that_is_known(spoilt, rule):
    assert verdict(replace(sighted(), **spoilt)) == rule


def test_noise_that_is_not_stated_may_be_nan_in_its_whole_row_and_column():
    partly = np.array([[0.1, np.nan, 0], [np.nan, np.nan, np.nan], [0, np.nan, 0.1]])
    assert verdict(sighted(covariance=partly)) == "kept"
    hidden = np.array([[0.1, np.nan, 0], [np.nan, 0.1, 0], [0, 0, 0.1]])
    assert verdict(sighted(covariance=hidden)) == "covariance_not_finite"


# -- what needs order --------------------------------------------------------------------------------------------


def at(seconds, x, y=0.0, yaw=0.0) -> OdometryPose:
    return wheels(round(seconds * SECOND), (x, y, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))


def judged(*items, space="3d") -> list[str]:
    """`x@seconds` of what is kept, and the rules of decisions."""
    return [
        f"{i.verdict} {i.reason}@{i.stamp / SECOND:g}"
        if isinstance(i, Decision)
        else f"{i.pose[0]:g}@{i.stamp / SECOND:g}"
        for i in rechecked(items, config(space, max_speed=2.0))
    ]


def test_a_second_message_with_a_stamp_is_refused():
    assert judged(at(1, 0), at(1, 0.1), at(2, 1)) == ["0@1", "refused duplicate@1", "1@2"]


def test_a_lone_teleport_is_refused_when_the_next_message_contradicts_it():
    assert judged(at(1, 0), at(2, 500), at(3, 2)) == ["0@1", "refused teleport@2", "2@3"]
    assert judged(at(1, 0), at(2, 500), at(3, -500), at(4, 3)) == [
        "0@1", "refused teleport@2", "refused teleport@3", "3@4",
    ]  # fmt: skip


def test_a_doubt_at_the_end_of_the_input_is_refused():
    assert judged(at(1, 0), at(2, 500)) == ["0@1", "refused teleport@2"]


def test_a_duplicated_teleport_is_no_witness_of_itself():
    assert judged(at(1, 0), at(2, 500), at(2, 500), at(3, 2)) == [
        "0@1", "refused duplicate@2", "refused teleport@2", "2@3",
    ]  # fmt: skip


def test_small_steps_may_jump_by_a_burst():
    assert judged(at(1, 0), at(1.001, 0.9)) == ["0@1", "0.9@1.001"]


def test_a_message_from_another_frame_is_refused_unless_the_frame_has_changed_for_good():
    other = {s: replace(at(s, s), frame="visual_odom") for s in (2, 2.5, 3, 4)}
    assert judged(at(1, 0), other[2], at(3, 2), other[4], at(5, 4)) == [
        "0@1", "refused frame_changed@2", "2@3", "refused frame_changed@4", "4@5",
    ]  # fmt: skip
    assert judged(at(1, 0), other[2], other[3], other[4]) == [
        "0@1",
        "accepted restart@3",
        "0@2",
        "1@3",
        "2@4",
    ]


@DIMENSIONS
def test_after_a_restart_the_robot_goes_on_as_it_did(space):
    """At constant velocity until the next message; motions before and after are those of the messages."""
    old, new = [at(1, 0), at(2, 1, 0, 0.5)], [at(3, 70, 5, 2.0), at(4, 70, 6, 2.2), at(5, 70.5, 7, 2.0)]
    kept = list(rechecked([*old, *new], config(space, max_speed=2.0)))
    restart = [item for item in kept if isinstance(item, Decision)]
    assert [(d.verdict, d.reason) for d in restart] == [("accepted", "restart")]
    track = Track(SPACES[space], OdometrySource())
    raw = Track(SPACES[space], OdometrySource())
    for item in kept:
        if isinstance(item, OdometryPose):
            track.add(item.stamp, SPACES[space].pose(item.pose.tolist()))
    for item in [*old, *new]:
        raw.add(item.stamp, SPACES[space].pose(item.pose.tolist()))
    assert len(track) == 5
    assert [item.epoch for item in kept if isinstance(item, OdometryPose)] == [0, 0, 1, 1, 1]
    step = raw.motion(1 * SECOND, 2 * SECOND).pose
    assert track.motion(2 * SECOND, 3 * SECOND).pose.equals(step, 1e-9)
    for a, b in [(1, 2), (3, 4), (4, 5)]:
        assert track.motion(a * SECOND, b * SECOND).pose.equals(raw.motion(a * SECOND, b * SECOND).pose, 1e-9)


def test_each_epoch_tells_where_its_frame_lies_in_the_first():
    kept = list(rechecked([at(1, 0), at(2, 50), at(3, 51)], config(max_speed=2.0)))
    first, *later = [item for item in kept if isinstance(item, OdometryPose)]
    assert first.origin == HERE
    for item, raw in zip(later, (50, 51), strict=True):
        assert item.pose[0] == item.origin[0] + raw == raw - 50


def test_a_step_that_its_own_twist_contradicts_is_a_jump():
    slow = [replace(at(s, x), twist=frozen((0.5, 0, 0, 0, 0, 0))) for s, x in ((1, 0), (1.1, 3), (1.2, 0.1))]
    settings = config(max_speed=100.0)
    told = [i for i in rechecked(slow, settings) if isinstance(i, Decision)]
    assert [(d.reason, d.stamp) for d in told] == [("teleport", slow[1].stamp)]
    assert told[0].threshold == pytest.approx(2 * 0.5 + ACCELERATION * 0.1)
    silent = [replace(item, twist=STILL, twist_covariance=UNKNOWN) for item in slow]
    assert list(rechecked(silent, settings)) == silent


def test_an_odometry_that_starts_at_zero_again_has_restarted_however_small_the_step():
    settings = config(max_speed=100.0)
    drive = [at(s, x) for s, x in ((1, 1.0), (1.1, 1.1), (1.2, 0.0), (1.3, 0.1))]
    restarted = list(rechecked(drive, settings))
    assert [(i.verdict, i.reason) for i in restarted if isinstance(i, Decision)] == [("accepted", "restart")]
    xs = [float(i.pose[0]) for i in restarted if isinstance(i, OdometryPose)]
    assert xs == pytest.approx([1.0, 1.1, 1.2, 1.3])
    lone = [*drive[:3], at(1.3, 1.3)]
    assert [i.reason for i in rechecked(lone, settings) if isinstance(i, Decision)] == ["origin"]


def test_a_second_restart_builds_on_the_first():
    assert judged(at(1, 0), at(2, 50), at(3, 51), at(4, 200), at(5, 201)) == [
        "0@1", "accepted restart@3", "0@2", "1@3", "accepted restart@5", "2@4", "3@5",
    ]  # fmt: skip


def test_after_a_restart_the_covariance_still_means_the_same_at_the_child():
    space = SPACES["3d"]
    turned = [at(1, 0), at(2, 50, 0, 1.2), at(3, 51, 0, 1.2)]
    kept = [i for i in rechecked(turned, config(max_speed=2.0)) if isinstance(i, OdometryPose)]
    for before, after in zip(turned[1:], kept[1:], strict=True):
        expected = space.covariance(before.covariance, space.pose(before.pose.tolist()))
        got = space.covariance(after.covariance, space.pose(after.pose.tolist()))
        np.testing.assert_allclose(got, expected, atol=1e-12)
        assert not after.pose.flags.writeable
        assert not after.covariance.flags.writeable


def test_other_sources_pass_and_each_odometry_source_has_its_own_past():
    settings = Config(sources={name: OdometrySource(max_speed=2.0) for name in ("wheels", "visual")})
    visual = replace(at(1, 900), source="visual")
    items = [at(1, 0), visual, loop(), at(2, 1), replace(at(2, 901), source="visual")]
    assert list(rechecked(items, settings)) == items


def relative_rules(*items, settings=None) -> list[str]:
    return [i.reason if isinstance(i, Decision) else "kept" for i in rechecked(items, settings or config())]


def test_a_loop_that_is_told_twice_counts_once():
    again = replace(loop(), stamp=9 * SECOND)  # sent once more, later
    first, refused = rechecked([loop(), again], config())
    assert isinstance(first, RelativePose)
    assert (refused.id, refused.verdict, refused.ends) == ("loops/9.000000000", "refused", again.ends)
    assert relative_rules(loop(), again, again) == ["kept", "duplicate", "duplicate"]


def test_another_look_between_the_same_moments_is_no_repetition():
    other = [
        loop(pose=(1e-9, 0, 0, 0, 0, 0, 1)),
        loop(stamps=(SECOND, 3 * SECOND)),
        loop(stamps=(2 * SECOND, SECOND)),
        replace(loop(), source="lidar"),
        replace(loop(), frame_i="camera"),
    ]
    assert relative_rules(loop(), *other) == ["kept"] * 6


def test_the_edges_of_a_graph_file_may_repeat():
    edge = loop(information=np.eye(3))
    assert relative_rules(edge, edge) == ["kept", "kept"]


def test_only_the_newest_relative_poses_are_remembered(monkeypatch):
    monkeypatch.setattr("slam_backend.core.firewall.repeats.MOST_WAITING", 10)
    loops = [loop(stamps=(SECOND, n * SECOND)) for n in range(2, 14)]
    assert relative_rules(*loops, loops[-10], loops[0]) == ["kept"] * 12 + ["duplicate", "kept"]


def test_an_absolute_pose_must_be_in_the_map():
    odom, settings = replace(localized(), parent="odom"), config()
    assert relative_rules(odom, *(replace(localized(), parent=p) for p in ("", "map", "/map"))) == [
        "other_frame", "kept", "kept", "kept",
    ]  # fmt: skip
    assert relative_rules(odom, settings=settings.model_copy(update={"map_frame": "odom"})) == ["kept"]


def test_a_robot_without_covariances_passes_untouched():
    blank = replace(wheels(), covariance=UNKNOWN, twist_covariance=UNKNOWN)
    assert verdict(blank) == "kept"
    assert verdict(blank, config(noise="twist")) == "kept accepted check/zero_covariance"
