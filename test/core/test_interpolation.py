"""Between keyframes the odometry gives the shape: met against gtsam, against its own formula, and against the truth."""

import gtsam
import numpy as np
import pytest

from slam_backend.core.geometry import inverse_of, matrix_of, seven_of_matrix
from slam_backend.core.measurement import Array
from slam_backend.core.trajectory import Stamps, Trajectory, shaped
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import simulate

STEP = 50_000_000  # ns


def wandering(seed: int, count: int, angle: float = 0.3) -> Trajectory:
    """A path in 3-D, one pose per STEP."""
    rng = np.random.default_rng(seed)
    steps = [gtsam.Pose3.Expmap(rng.normal(0, (angle,) * 3 + (0.5,) * 3)) for _ in range(count)]
    poses = [gtsam.Pose3()]
    for step in steps[1:]:
        poses.append(poses[-1].compose(step))
    stamps = np.arange(count, dtype=np.int64) * STEP + 1_700_000_000_123_456_789
    return Trajectory(stamps, seven_of_matrix(np.stack([pose.matrix() for pose in poses])))


def every(track: Trajectory, n: int, moved: Array | None = None) -> Trajectory:
    """Each nth sample as a keyframe, perturbed by poses (N, 4, 4) at its tangent."""
    poses = track.poses[::n]
    return Trajectory(track.stamps[::n], seven_of_matrix(poses if moved is None else poses @ moved))


def noise(seed: int, count: int, sigma: float) -> Array:
    rng = np.random.default_rng(seed)
    return np.stack([gtsam.Pose3.Expmap(rng.normal(0, sigma, 6)).matrix() for _ in range(count)])


def inside(track: Trajectory, count: int, seed: int = 0) -> Stamps:
    return np.random.default_rng(seed).integers(track.stamps[0], track.stamps[-1], count, endpoint=True)


@pytest.mark.parametrize("angle", [1.0, 1e-3, 1e-8, 0.0])
def test_plain_interpolation_is_gtsams_for_position_and_rotation_apart(angle: float) -> None:
    track = wandering(1, 60, angle)
    wanted = inside(track, 300)
    for stamp, found in zip(wanted.tolist(), matrix_of(track.at(wanted)), strict=True):
        left = min((stamp - int(track.stamps[0])) // STEP, len(track) - 2)
        share = (stamp - int(track.stamps[left])) / STEP
        a, b = (gtsam.Pose3(pose) for pose in track.poses[left : left + 2])
        np.testing.assert_allclose(
            found[:3, :3], a.rotation().slerp(share, b.rotation()).matrix(), atol=1e-12
        )
        np.testing.assert_allclose(
            found[:3, 3], (1 - share) * a.translation() + share * b.translation(), atol=1e-12
        )


@pytest.mark.parametrize("sigma", [0.3, 1e-4, 1e-9, 0.0])
def test_shaped_interpolation_is_its_formula_in_gtsams_poses(sigma: float) -> None:
    odometry = wandering(2, 81)
    keyframes = every(odometry, 8, noise(3, 11, sigma))
    wanted = inside(keyframes, 300)
    sample = {t: gtsam.Pose3(m) for t, m in zip(wanted.tolist(), matrix_of(odometry.at(wanted)), strict=True)}
    for stamp, found in zip(wanted.tolist(), matrix_of(shaped(keyframes, odometry, wanted)), strict=True):
        k = min((stamp - int(keyframes.stamps[0])) // (8 * STEP), len(keyframes) - 2)
        share = (stamp - int(keyframes.stamps[k])) / (8 * STEP)
        Xa, Xb = (gtsam.Pose3(pose) for pose in keyframes.poses[k : k + 2])
        Oa, Ob = (gtsam.Pose3(odometry.poses[8 * j]) for j in (k, k + 1))
        missing = Oa.between(Ob).between(Xa.between(Xb))
        bent = gtsam.Pose3.Expmap(share * gtsam.Pose3.Logmap(missing))
        expected = Xa.compose(Oa.between(sample[stamp])).compose(bent)
        np.testing.assert_allclose(found, expected.matrix(), atol=1e-11)


def test_keyframes_are_met_to_the_bit_and_approached_from_both_sides() -> None:
    odometry = wandering(4, 81)
    keyframes = every(odometry, 8, noise(5, 11, 0.2))
    np.testing.assert_array_equal(shaped(keyframes, odometry, keyframes.stamps), keyframes.sevens)
    inner = keyframes.stamps[1:-1]
    for beside in (inner - 1, inner + 1):
        near = matrix_of(shaped(keyframes, odometry, beside))
        np.testing.assert_allclose(near, keyframes.poses[1:-1], atol=1e-6)


def test_keyframes_between_samples_of_the_odometry_are_met_too() -> None:
    odometry = wandering(6, 81)
    stamps = odometry.stamps[4:-4:8] + STEP // 3
    keyframes = Trajectory(
        stamps, seven_of_matrix(matrix_of(odometry.at(stamps)) @ noise(7, len(stamps), 0.1))
    )
    for beside in (stamps[1:-1] - 1, stamps[1:-1] + 1):
        near = matrix_of(shaped(keyframes, odometry, beside))
        np.testing.assert_allclose(near, keyframes.poses[1:-1], atol=1e-6)


def test_an_odometry_that_agrees_with_the_keyframes_is_followed_exactly() -> None:
    odometry = wandering(8, 81)
    keyframes = every(odometry.from_start(np.array([5.0, -3, 1, 0.5, 0.5, 0.5, 0.5])), 16)
    found = matrix_of(shaped(keyframes, odometry, odometry.stamps))
    expected = keyframes.poses[0] @ inverse_of(odometry.poses[0]) @ odometry.poses
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_without_odometry_inside_a_stretch_interpolation_is_plain() -> None:
    """No odometry; one that has only the keyframes, as a graph file's; one that covers but a part."""
    odometry = wandering(9, 81)
    keyframes = every(odometry, 8, noise(10, 11, 0.2))
    wanted = inside(keyframes, 200)
    plain = keyframes.at(wanted)
    empty = Trajectory(odometry.stamps[:0], odometry.sevens[:0])
    for track in (empty, every(odometry, 8)):
        np.testing.assert_array_equal(shaped(keyframes, track, wanted), plain)
    part = Trajectory(odometry.stamps[20:61], odometry.sevens[20:61])
    found, whole = shaped(keyframes, part, wanted), shaped(keyframes, odometry, wanted)
    covered = (wanted >= keyframes.stamps[3]) & (wanted <= keyframes.stamps[7])
    np.testing.assert_array_equal(found[~covered], plain[~covered])
    np.testing.assert_array_equal(found[covered], whole[covered])


def test_outside_the_keyframes_nothing_is_known() -> None:
    odometry = wandering(11, 41)
    keyframes = Trajectory(odometry.stamps[8:33:8], odometry.sevens[8:33:8])
    found = shaped(keyframes, odometry, odometry.stamps[[0, 7, 8, 32, 33]])
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), [True, True, False, False, True])
    assert shaped(keyframes, odometry, np.zeros(0, dtype=np.int64)).shape == (0, 7)
    single = Trajectory(odometry.stamps[:1], odometry.sevens[:1])
    found = shaped(single, odometry, odometry.stamps[:2])
    np.testing.assert_array_equal(found[0], single.sevens[0])
    assert np.isnan(found[1]).all()
    nothing = Trajectory(odometry.stamps[:0], odometry.sevens[:0])
    assert np.isnan(shaped(nothing, odometry, [3])).all()


def test_half_a_turn_is_no_trouble() -> None:
    """The odometry turned the other way about than the keyframes say: the missing rotation is 180 degrees."""
    stamps = np.array([0, 50, 100], dtype=np.int64)
    still = np.array([[0.0, 0, 0, 0, 0, 0, 1]] * 3)
    turned = np.array([[0.0, 0, 0, 0, 0, 0, 1], [2.0, 0, 0, 0, 0, 1, 0]])
    found = shaped(Trajectory(stamps[::2], turned), Trajectory(stamps, still), [50])
    np.testing.assert_allclose(found[0], [1, -1, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


@pytest.mark.parametrize("scenario", ["city", "spiral"])
def test_the_shape_is_closer_to_the_truth_than_a_straight_line(scenario: str) -> None:
    """Keyframes at the true pose every 5 m of a simulated drive, odometry with its usual noise between."""
    drive = simulate(scenario, 3, Options(poses=800))
    messages = [item for item in drive.measurements if item.source == "wheels"]
    odometry = Trajectory(
        np.array([item.stamp for item in messages], dtype=np.int64),
        np.stack([item.pose for item in messages]),
    )
    truth = Trajectory(drive.stamps, drive.sevens)
    keyframes = Trajectory(truth.stamps[::10], truth.sevens[::10])
    wanted = truth.stamps[truth.stamps <= keyframes.stamps[-1]]

    def error(sevens: Array) -> float:
        return float(np.sqrt(np.mean((sevens[:, :3] - truth.at(wanted)[:, :3]) ** 2)))

    assert error(shaped(keyframes, odometry, wanted)) < 0.25 * error(keyframes.at(wanted))
