"""Motion between any two stamps, with honest noise; where a stamp lands; when a keyframe is due."""

import numpy as np
import pytest

from slam_backend.core.config import Keyframes, OdometrySource
from slam_backend.core.graph import keyframe
from slam_backend.core.keyframes import Timeline, Track, due
from slam_backend.core.measurement import SECOND
from slam_backend.core.space import SPACES

BOTH = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
FLOORLESS = {"sigma_translation_floor": 1e-9, "sigma_rotation_floor": 1e-9}
STEP = SECOND // 10


def twist_of(space) -> np.ndarray:
    """m and rad per step: forward, a little sideways, turning."""
    return (
        np.array([0.1, 0.01, 0.03]) if space.name == "2d" else np.array([0.01, -0.02, 0.03, 0.1, 0.01, 0.02])
    )


def driven(space, noise, steps=20, covariance=None) -> Track:
    """A track along a constant twist, one sample per STEP."""
    track, pose = Track(space, noise), space.identity
    for n in range(steps + 1):
        track.add(n * STEP, pose, covariance)
        pose = pose.compose(space.expmap(twist_of(space)))
    return track


# -- poses -------------------------------------------------------------------------------------------------------


@BOTH
def test_between_samples_the_track_follows_the_constant_twist(space):
    track = driven(space, OdometrySource())
    for stamp in (0, STEP // 3, 7 * STEP, 7 * STEP + 12_345_678, 20 * STEP):
        expected = space.expmap(twist_of(space) * stamp / STEP)
        assert track.pose(stamp).equals(expected, 1e-9)
    motion = track.motion(STEP // 2, 9 * STEP + STEP // 4)
    assert motion.pose.equals(space.expmap(twist_of(space) * 8.75), 1e-9)


def test_a_track_covers_what_lies_between_its_first_and_last_sample():
    track = driven(SPACES["2d"], OdometrySource())
    assert [track.covers(s) for s in (-1, 0, 5, 20 * STEP, 20 * STEP + 1)] == [False, True, True, True, False]
    assert not Track(SPACES["2d"], OdometrySource()).covers(0)


@BOTH
def test_samples_may_come_out_of_order(space):
    straight, shuffled = driven(space, OdometrySource()), Track(space, OdometrySource())
    for n in np.random.default_rng(1).permutation(21):
        shuffled.add(int(n) * STEP, space.expmap(twist_of(space) * n))
    assert shuffled.newest == straight.newest
    for stamp in range(0, 20 * STEP, STEP // 2):
        assert shuffled.pose(stamp).equals(straight.pose(stamp), 1e-9)


@BOTH
def test_a_sample_that_was_asked_for_stays_itself_when_others_come_before_it_or_go(space):
    track = driven(space, OdometrySource())
    asked = {n: track.pose(n * STEP) for n in range(15, 21)}
    late = space.expmap(3 * twist_of(space))
    track.add(10 * STEP + 1, late)
    assert space.size(track.pose(10 * STEP + 1).between(late)) == pytest.approx((0, 0), abs=1e-12)
    for n, pose in asked.items():
        assert space.size(track.pose(n * STEP).between(pose)) == pytest.approx((0, 0), abs=1e-12)
    track.forget(17 * STEP)
    assert space.size(track.pose(19 * STEP).between(asked[19])) == pytest.approx((0, 0), abs=1e-12)


def test_an_insertion_does_not_expose_the_sample_of_a_keyframe_to_thinning():
    space, track = SPACES["2d"], Track(SPACES["2d"], OdometrySource())
    for n in range(4):
        track.add(n * STEP, space.expmap(np.array([n * n, n % 2, 0.0])))
    track.protect()
    kept = track.pose(3 * STEP)
    track.add(STEP // 2, space.identity)
    for n in range(200):
        track.add(4 * STEP + n, space.identity)
    assert track.pose(3 * STEP).equals(kept, 1e-12)


# -- noise -------------------------------------------------------------------------------------------------------


def sigmas(space, covariance) -> tuple[float, float]:
    """Of a translation and of a rotation axis."""
    diagonal = np.sqrt(np.diag(covariance))
    return (diagonal[0], diagonal[2]) if space.name == "2d" else (diagonal[3], diagonal[0])


@BOTH
def test_the_models_sigmas_grow_with_the_square_root_of_path_and_turn(space):
    noise = OdometrySource(
        sigma_translation_per_meter=0.1,
        sigma_rotation_per_meter=0.02,
        sigma_translation_per_radian=0.3,
        sigma_rotation_per_radian=0.04,
        **FLOORLESS,
    )
    track = Track(space, noise)
    track.add(1, space.identity)
    track.add(2, space.from_extrinsics((4.0, 0, 0, 0, 0, 0)))
    track.add(3, space.from_extrinsics((4.0, 0, 0, 0, 0, 0.25)))
    assert sigmas(space, track.motion(1, 2).covariance) == pytest.approx((0.2, 0.04))
    assert sigmas(space, track.motion(2, 3).covariance) == pytest.approx((0.15, 0.02))


@BOTH
@pytest.mark.parametrize("mode", ["model", "twist", "pose"])
def test_a_robot_that_stands_still_keeps_the_floor(space, mode):
    track = Track(space, OdometrySource(noise=mode, sigma_translation_floor=0.01, sigma_rotation_floor=0.002))
    for stamp in (1, 2, 3):
        track.add(stamp, space.identity, np.zeros((space.dimension,) * 2))
    assert sigmas(space, track.motion(1, 3).covariance) == pytest.approx((0.01, 0.002))


@BOTH
@pytest.mark.parametrize("mode", ["model", "twist", "pose"])
def test_no_time_is_no_motion_and_backwards_is_the_inverse(space, mode):
    step = 1e-6 * np.eye(space.dimension)
    track = driven(space, OdometrySource(noise=mode), covariance=step)
    there, back = track.motion(3 * STEP, 9 * STEP), track.motion(9 * STEP, 3 * STEP)
    assert back.pose.equals(there.pose.inverse(), 1e-12)
    np.testing.assert_allclose(back.covariance, there.inverse().covariance, atol=1e-15)
    still = track.motion(3 * STEP, 3 * STEP)
    assert still.pose.equals(space.identity, 0)
    assert not still.covariance.any()


@BOTH
def test_the_inverse_of_a_motion_has_its_covariance_at_the_other_end(space, agree, spread):
    rng = np.random.default_rng(2)
    track = driven(
        space, OdometrySource(noise="twist"), covariance=1e-6 * spread(rng, np.ones(space.dimension))
    )
    motion = track.motion(0, 10 * STEP)
    errors = rng.multivariate_normal(np.zeros(space.dimension), motion.covariance, size=8_000)
    back = motion.inverse()
    agree(
        [space.logmap(back.pose.between(motion.pose.compose(space.expmap(e)).inverse())) for e in errors],
        back.covariance,
    )


@BOTH
def test_motions_chain_as_independent_errors(space, agree, spread):
    rng = np.random.default_rng(3)
    tracks = [
        driven(
            space,
            OdometrySource(noise="twist", **FLOORLESS),
            covariance=1e-6 * spread(rng, np.ones(space.dimension)),
        )
        for _ in "ab"
    ]
    first, second = (track.motion(0, 6 * STEP) for track in tracks)
    zero, chained = np.zeros(space.dimension), first.then(second)
    pairs = zip(
        rng.multivariate_normal(zero, first.covariance, size=8_000),
        rng.multivariate_normal(zero, second.covariance, size=8_000),
        strict=True,
    )
    agree(
        [
            space.logmap(
                chained.pose.between(
                    first.pose.compose(space.expmap(one)).compose(second.pose).compose(space.expmap(two))
                )
            )
            for one, two in pairs
        ],
        chained.covariance,
    )


@BOTH
def test_twist_noise_is_that_of_independent_errors_of_each_step(space, agree, spread):
    rng = np.random.default_rng(4)
    step = 1e-6 * spread(rng, np.ones(space.dimension))
    track = driven(space, OdometrySource(noise="twist", **FLOORLESS), covariance=step)
    motion, one = track.motion(2 * STEP, 12 * STEP), space.expmap(twist_of(space))
    errors = rng.multivariate_normal(np.zeros(space.dimension), step, size=(4_000, 10))

    def driven_with(wrong):
        pose = space.identity
        for error in wrong:
            pose = pose.compose(one).compose(space.expmap(error))
        return space.logmap(motion.pose.between(pose))

    agree([driven_with(wrong) for wrong in errors], motion.covariance)


@BOTH
@pytest.mark.parametrize("cut", [7 * STEP, 7 * STEP + STEP // 3, 3 * STEP + 1])
def test_twist_noise_of_two_stretches_adds_up_to_that_of_the_whole(space, cut, spread):
    """Wherever the stretch is cut, at a sample or between two."""
    rng = np.random.default_rng(5)
    step = 1e-4 * spread(rng, np.ones(space.dimension))
    track = driven(space, OdometrySource(noise="twist", **FLOORLESS), covariance=step)
    start, end = STEP + STEP // 7, 15 * STEP + STEP // 2
    whole = track.motion(start, end)
    parts = track.motion(start, cut).then(track.motion(cut, end))
    assert parts.pose.equals(whole.pose, 1e-9)
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-9, atol=1e-15)


@BOTH
def test_a_twist_without_variance_takes_the_models_growth(space):
    """A covariance of zeros means the configured default, not certainty; so does a single zero on the diagonal."""
    straight = {
        "sigma_translation_per_meter": 0.1,
        "sigma_rotation_per_meter": 0.0,
        "noise": "twist",
        **FLOORLESS,
    }
    track = Track(space, OdometrySource(**straight))
    partly = Track(space, OdometrySource(**straight))
    stated = np.diag(np.full(space.dimension, 1e-6))
    stated[0 if space.name == "2d" else 3] = 0.0  # along the way
    for n in range(5):
        pose = space.from_extrinsics((1.0 * n, 0, 0, 0, 0, 0))
        track.add(n, pose, np.zeros((space.dimension,) * 2))
        partly.add(n, pose, stated)
    assert sigmas(space, track.motion(0, 4).covariance)[0] == pytest.approx(0.2)
    assert sigmas(space, partly.motion(0, 4).covariance)[0] == pytest.approx(0.2)


@BOTH
def test_pose_noise_is_what_the_stated_covariance_grew_by(space, agree, spread):
    """A filter that states P(start) and P(end): the motion's own share makes the one from the other."""
    rng = np.random.default_rng(6)
    track = Track(space, OdometrySource(noise="pose", **FLOORLESS))
    motion = space.expmap(twist_of(space) * 5)
    before = 1e-6 * spread(rng, np.ones(space.dimension))
    grown = 1e-6 * spread(rng, 2 * np.ones(space.dimension))
    adjoint = motion.inverse().AdjointMap()
    track.add(1, space.identity, before)
    track.add(3, motion, adjoint @ before @ adjoint.T + grown)
    np.testing.assert_allclose(track.motion(1, 3).covariance, grown, atol=1e-14)


@BOTH
@pytest.mark.parametrize("ending", [0.0, 0.5, 1.0])
def test_pose_noise_that_shrinks_or_stands_still_falls_back_to_the_model(space, ending):
    noises = [OdometrySource(noise=mode) for mode in ("pose", "model")]
    shrinking, model = (Track(space, noise) for noise in noises)
    motion = space.from_extrinsics((1.0, 0, 0, 0, 0, 0))
    for track in (shrinking, model):
        track.add(1, space.identity, 1e-4 * np.eye(space.dimension))
        track.add(3, motion, ending * 1e-4 * np.eye(space.dimension))
    np.testing.assert_array_equal(shrinking.motion(1, 3).covariance, model.motion(1, 3).covariance)


# -- memory ------------------------------------------------------------------------------------------------------


@BOTH
def test_thinning_keeps_the_interpolation_and_the_twist_noise(space, spread):
    rng = np.random.default_rng(7)
    step = 1e-6 * spread(rng, np.ones(space.dimension))
    noise = OdometrySource(noise="twist", **FLOORLESS)
    thinned, whole = driven(space, noise, 64, step), Track(space, noise)
    for n in range(65):
        whole.add(n * STEP, space.expmap(twist_of(space) * n), step)
        whole.protect()  # a keyframe at every sample: nothing may go
    assert len(thinned) < len(whole) == 65
    for stamp in range(0, 64 * STEP, 3 * STEP // 2):
        assert thinned.pose(stamp).equals(whole.pose(stamp), 1e-9)
    got, expected = thinned.motion(0, 64 * STEP), whole.motion(0, 64 * STEP)
    np.testing.assert_allclose(got.covariance, expected.covariance, rtol=1e-6, atol=1e-12)


def test_a_parked_robot_does_not_fill_the_memory():
    space = SPACES["2d"]
    track = Track(space, OdometrySource(noise="twist", **FLOORLESS))
    step = 1e-8 * np.eye(3)
    for n in range(100_000):
        track.add(n * STEP, space.identity, step)
    assert len(track) <= 65
    assert track.covers(0)
    assert track.newest == 99_999 * STEP
    np.testing.assert_allclose(track.motion(0, track.newest).covariance, 99_999 * step, rtol=1e-6)


# -- keyframes ---------------------------------------------------------------------------------------------------


def timeline(*stamps) -> Timeline:
    made = Timeline()
    for index, stamp in enumerate(stamps):
        made.add(keyframe(index, stamp))
    return made


@BOTH
def test_a_stamp_lands_at_the_keyframe_that_is_nearest_by_distance_moved(space):
    """The robot waits most of the time, then moves: what matters is the way, not the time."""
    track = Track(space, OdometrySource())
    for n, x in enumerate((0.0, 0.0, 0.0, 0.0, 1.0, 2.0)):
        track.add(n * STEP, space.from_extrinsics((x, 0, 0, 0, 0, 0)))
    frames = timeline(0, 5 * STEP)
    waiting, moving = frames.place(3 * STEP, track, space), frames.place(4 * STEP + STEP // 2, track, space)
    assert (waiting.keyframe.index, moving.keyframe.index) == (0, 1)
    assert moving.motion.pose.equals(space.from_extrinsics((-0.5, 0, 0, 0, 0, 0)), 1e-9)
    assert np.linalg.eigvalsh(moving.motion.covariance)[0] > 0


@BOTH
def test_where_nothing_moved_the_nearer_stamp_counts(space):
    track = Track(space, OdometrySource())
    for n in range(11):
        track.add(n, space.identity)
    assert timeline(0, 10).place(6, track, space).keyframe.index == 1


def test_an_exact_stamp_lands_without_motion_and_outside_there_is_no_landing():
    space = SPACES["2d"]
    track, frames = driven(space, OdometrySource()), timeline(2 * STEP, 9 * STEP, 5 * STEP)
    exact = frames.place(5 * STEP, track, space)
    assert (exact.keyframe.index, exact.motion) == (2, None)
    assert frames.place(2 * STEP - 1, track, space) is None
    assert frames.place(9 * STEP + 1, track, space) is None
    assert Timeline().place(5, track, space) is None
    assert timeline(-10 * STEP, 40 * STEP).place(-STEP, track, space) is None  # the track does not cover it


def test_keyframes_are_kept_by_index_by_stamp_and_in_order():
    frames = timeline(20, 40, 30)
    assert [k.stamp for k in frames.keyframes] == [20, 40, 30]
    assert [k.stamp for k in frames.in_order()] == [20, 30, 40]
    assert frames.newest.stamp == 40
    assert frames.at(30).index == 2
    assert frames.at(31) is None
    frames.drop(frames.at(30))
    assert [k.stamp for k in frames.in_order()] == [20, 40]
    assert len(frames) == 2


@BOTH
def test_a_keyframe_is_due_by_distance_by_angle_by_time_or_always(space):
    def asks(six=(0, 0, 0, 0, 0, 0), seconds=0.0, **settings):
        return due(Keyframes(**settings), space, space.from_extrinsics(six), round(seconds * SECOND))

    assert not asks((0.49, 0, 0, 0, 0, 0.19), 1e6)
    assert asks((0.3, 0.41, 0, 0, 0, 0))
    assert asks((0, 0, 0, 0, 0, -0.201))
    assert asks(seconds=2.0, time=2.0)
    assert not asks(seconds=1.999, time=2.0)
    assert asks(every=True)
