"""Features through images: what a message says, what a track becomes, what is refused and removed, and how sure the pose is then."""

from collections import Counter

import gtsam
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig, BadMessage
from slam_backend.core.geometry import matrix_of, seven_of_matrix
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.camera import CameraModel
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.pixels import PixelFrame, decode
from slam_backend.core.sensors.reprojection import Reprojection
from slam_backend.core.sensors.triangulation import Lens, images
from slam_backend.core.variables import value_in
from slam_backend.io.encode import encode_cloud
from slam_backend.io.replay import settled_stream
from slam_backend.lab.features import EYE
from slam_backend.lab.simulate import Options, simulate

LENS = Lens(400.0, 400.0, 320.0, 240.0)
SIX = [0.2, 0.0, 0.1, -np.pi / 2, 0.0, -np.pi / 2]
MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(*SIX[3:]), np.array(SIX[:3]))
POINTS = np.random.default_rng(0).uniform([8, -5, -2], [16, 5, 3], (40, 3))


def settings(**more):
    pixels = {
        "kind": "pixels",
        "topic": "/f",
        "camera": {"fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0},
        **more,
    }
    return {
        "space": "3d", "keyframes": {"every": True}, "extrinsics": {EYE: SIX}, "sources": ["wheels", "features"],
        "wheels": {"kind": "odometry", "topic": "/o"}, "features": pixels,
    }  # fmt: skip


class Drive:
    """Half a metre to the left and ahead a second, an image at each stop; every pixel true unless it is told otherwise."""

    def __init__(self, **more) -> None:
        self.backend, self.decisions, self.k = Backend(config_from(settings(**more))), [], 0

    def pose(self, k: int) -> np.ndarray:
        pose = np.eye(4)
        pose[:2, 3] = 0.4 * k, 0.3 * k
        return pose

    def go(self, shown=None, wrong=None, ids=None, stereo=False) -> Counter:
        """One stop. shown: rows of POINTS; wrong: row -> pixel. What was decided, by rule."""
        stamp, pose = (self.k + 1) * SECOND, self.pose(self.k)
        shown = list(range(len(POINTS))) if shown is None else shown
        lens = LENS._replace(baseline=0.3) if stereo else LENS
        pixels, _ = images(POINTS[shown], np.tile(pose @ MOUNT.matrix(), (len(shown), 1, 1)), lens)
        if not stereo:
            pixels[:, 2] = np.nan
        for row, pixel in (wrong or {}).items():
            pixels[shown.index(row), :2] = pixel
        numbers = np.array(shown if ids is None else ids, dtype=np.int64)
        sigmas = np.full(len(shown), 0.5)
        self.backend.add(PixelFrame(stamp, "features", EYE, numbers, frozen(pixels), frozen(sigmas)))
        told = self.backend.add(
            OdometryPose(
                stamp, "wheels", "odom", "base", seven_of_matrix(pose[None])[0], UNKNOWN, STILL, UNKNOWN
            )
        )
        found = [decision for update in told for decision in update.decisions]
        self.decisions += found
        self.k += 1
        return Counter(f"{each.stage}/{each.reason}" for each in found)

    def factors(self, number: int) -> list[str]:
        """What is in the graph of a feature: how many sightings each factor has."""
        return [
            "smart" if id_.endswith(":smart") else "point"
            for id_ in self.backend.solver.factors
            if id_.partition(":")[2].partition(":")[0] == str(number)
        ]


def test_a_cloud_with_id_u_and_v_is_a_frame():
    columns = {"id": np.array([3, 9], np.uint32), "u": np.array([1.5, 2.5]), "v": np.array([4.0, 5.0])}
    store = get_typestore(Stores.ROS2_JAZZY)

    def told(columns):
        return decode(
            store.deserialize_cdr(encode_cloud(SECOND, "eye", columns), "sensor_msgs/msg/PointCloud2"), "f"
        )

    mono = told(columns)
    np.testing.assert_array_equal(mono.ids, [3, 9])
    np.testing.assert_array_equal(mono.pixels[:, :2], [[1.5, 4.0], [2.5, 5.0]])
    assert np.isnan(mono.pixels[:, 2]).all()
    assert np.isnan(mono.sigmas).all()
    stereo = told({**columns, "ur": np.array([1.0, 2.0]), "sigma": np.array([0.5, 0.7])})
    np.testing.assert_array_equal(stereo.pixels[:, 2], [1.0, 2.0])
    odd = told({**columns, "id": np.array([0.5, np.nan])})
    np.testing.assert_array_equal(odd.ids, [-1, -1])
    with pytest.raises(BadMessage, match="'v'"):
        told({"id": columns["id"], "u": columns["u"]})


def test_a_track_waits_then_is_smart_then_a_point():
    drive = Drive(share=2.0)
    lives = []
    for _ in range(6):
        drive.go()
        lives.append(drive.factors(7))
    assert lives[0] == []
    assert lives[1:3] == [["smart"]] * 2
    assert lives[3:] == [["point"] * n for n in (4, 5, 6)]
    snapshot = drive.backend.snapshot()
    row = snapshot.names.index("features/7")
    np.testing.assert_allclose(snapshot.landmarks[row], POINTS[7], atol=1e-3)


def test_stereo_is_a_point_from_the_second_sighting_on():
    drive = Drive(camera={"fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0, "baseline": 0.3})
    drive.go(stereo=True)
    drive.go(stereo=True)
    assert drive.factors(7) == ["point", "point"]


@pytest.mark.parametrize("stereo", [False, True])
def test_factors_are_gtsams_own_with_derivatives_that_are_ones(stereo):
    """At a pose and a point off their places: error as projected by hand, Jacobian as by differences."""
    drive = Drive(
        share=2.0, point_after=2, camera={"fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0, "baseline": 0.3}
    )
    drive.go(stereo=stereo)
    drive.go(stereo=stereo)
    values = gtsam.Values()
    factor = next(f for id_, f in drive.backend.solver.factors.items() if id_.endswith(":7"))
    pose = gtsam.Pose3(drive.pose(0)).retract(np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.1]))
    point = POINTS[7] + [0.1, -0.2, 0.3]
    values.insert(factor.keys[0], pose)
    values.insert(factor.keys[1], point)
    lens = LENS._replace(baseline=0.3)
    rows = [0, 2, 1] if stereo else [0, 1]  # gtsam's order of a stereo pixel

    def image(pose, point):
        return images(point[None], pose.compose(MOUNT).matrix()[None], lens)[0][0][rows]

    true = images(POINTS[[7]], (gtsam.Pose3(drive.pose(0)).compose(MOUNT)).matrix()[None], lens)[0][0][rows]
    np.testing.assert_allclose(factor.factor.unwhitenedError(values), image(pose, point) - true, atol=1e-9)
    matrix, _ = factor.factor.linearize(values).jacobian()
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-6
        ends = [image(pose.retract(sign * step[:6]), point + sign * step[6:]) for sign in (1, -1)]
        np.testing.assert_allclose(matrix[:, k] * 0.5, (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-3)


def test_a_smart_factor_says_what_its_sightings_would_with_the_best_point():
    """Its error is that of the point factors at the best point, but for gtsam's linear triangulation, which is not quite the best."""
    from slam_backend.core.config import PixelsSource
    from slam_backend.core.sensors.frames import Frame

    rng = np.random.default_rng(4)
    make, values, sightings = Reprojection(PixelsSource()), gtsam.Values(), []
    for k in range(3):
        pose = gtsam.Pose3(Drive().pose(k))
        pixels, _ = images(POINTS[[5]], pose.compose(MOUNT).matrix()[None], LENS)
        pixels += rng.standard_normal(3)
        pixels[:, 2] = np.nan
        values.insert(k, pose)
        sightings.append((Frame(f"f/{k}/0", k, k, MOUNT, LENS, np.array([5]), pixels, np.ones(1)), 0))
    smart = make.smart(5, sightings)
    graph = gtsam.NonlinearFactorGraph()
    for each in sightings:
        graph.add(make.of_point(5, *each, 99).factor)
    for k in range(3):
        graph.add(gtsam.NonlinearEqualityPose3(k, values.atPose3(k)))
    best = gtsam.Values(values)
    best.insert(99, POINTS[5])
    best = gtsam.LevenbergMarquardtOptimizer(graph, best).optimize()
    assert smart.factor.error(values) == pytest.approx(graph.error(best), rel=0.01)
    assert smart.factor.error(values) == smart.factor.error(values)


def test_a_feature_that_jumps_is_refused_and_after_three_times_another_one():
    drive = Drive()
    for _ in range(5):
        drive.go()
    for _ in range(3):
        assert drive.go(wrong={7: (20.0, 20.0)}) == {"pixels/outlier": 1}
    refused = [d for d in drive.decisions if d.reason == "outlier"]
    assert refused[0].statistic > refused[0].threshold
    assert drive.factors(7) == ["point"] * 5
    for _ in range(5):
        assert not drive.go()
    names = drive.backend.snapshot().names
    assert "features/7" in names
    assert "features/7#2" in names


def test_two_sightings_that_no_point_explains_make_nothing():
    drive = Drive()
    drive.go()
    u, v, _ = images(POINTS[[7]], (drive.pose(1) @ MOUNT.matrix())[None], LENS)[0][0]
    assert drive.go(wrong={7: (u, v + 120.0)})["pixels/disagrees"] == 1
    assert drive.factors(7) == []


def test_a_point_that_ends_behind_a_camera_is_removed_and_forgotten():
    drive = Drive()
    for _ in range(6):
        drive.go()
    backend = drive.backend
    key = backend.landmark("features/7")
    estimate, behind = backend.estimate, POINTS[7] - [30.0, 0.0, 0.0]

    class Wrong:  # an estimate in which one point has gone astray; all else is true
        def __getattr__(self, name):
            return getattr(estimate, name)

        def point(self, asked):
            return behind if asked == key else estimate.point(asked)

    backend._applier.estimate = Wrong()
    assert drive.go()["points/behind"] == 6
    assert drive.factors(7) == []
    assert backend.parts.of(key) is None
    assert "features/7" not in backend.snapshot().names
    for _ in range(5):
        drive.go()
    assert "features/7#2" in backend.snapshot().names


def test_what_a_message_says_that_cannot_be_is_refused_pixel_by_pixel():
    drive = Drive()
    ids = [-1, 1, 1, 3, *range(10, 10 + len(POINTS) - 4)]
    told = drive.go(ids=ids, wrong={3: (np.nan, 1.0)})
    assert told == {"pixels/id": 1, "pixels/twice": 1, "pixels/not_finite": 1}


def test_without_a_calibration_or_between_keyframes_a_frame_is_refused():
    drive = Drive(camera={})
    assert drive.go() == {"pixels/no_camera": 1}
    drive = Drive()
    drive.go()
    drive.backend.add(PixelFrame(SECOND // 2, "features", EYE, np.arange(1), np.ones((1, 3)), np.ones(1)))
    assert drive.go()["pixels/uncovered"] == 1


@pytest.mark.parametrize(
    ("frame", "baseline", "told"),
    [("rear", 0.0, {"pixels/other_camera": 1}), (EYE, 0.0, {}), ("", 0.0, {}), ("right", 0.3, {})],
)
def test_the_calibration_of_another_camera_is_said_once(frame, baseline, told):
    """That of the right camera of a pair has its own frame, and is the one to take."""
    drive, lens = Drive(camera={}), LENS._replace(baseline=baseline)
    drive.backend.add(CameraModel(0, "features", lens, np.zeros(8), lens, frame))
    assert [drive.go(), drive.go()] == [told, {}]
    assert not told or f"seen from '{EYE}', with the calibration of 'rear'" in drive.decisions[0].detail


def test_a_keyframe_that_is_due_is_made_at_the_newest_image():
    config = config_from(settings() | {"keyframes": {"distance": 1.0}})
    backend = Backend(config)
    for n in range(40):
        stamp = SECOND + n * SECOND // 10
        if n % 3 == 0:
            at = stamp - SECOND // 50
            backend.add(PixelFrame(at, "features", EYE, np.arange(3), np.ones((3, 3)), np.ones(3)))
        seven = np.array([0.2 * n, 0, 0, 0, 0, 0, 1.0])
        backend.add(OdometryPose(stamp, "wheels", "odom", "base", seven, UNKNOWN, STILL, UNKNOWN))
    stamps = [k.stamp for k in backend.timeline.in_order()][1:]
    assert len(stamps) >= 6
    assert all((stamp + SECOND // 50 - SECOND) % (3 * SECOND // 10) == 0 for stamp in stamps)


def test_pixels_need_space():
    with pytest.raises(BadConfig, match="'features': pixels need space 3d"):
        config_from(settings() | {"space": "2d"})


def replayed(seed: int, **options):
    """A simulated flight: the back-end, its decisions by rule, and the truth."""
    made = simulate("flight", seed, Options(loop_rate=0.0, **options))
    config = config_from(made.settings)
    backend, rules = Backend(config), Counter()
    for item in settled_stream(made.measurements, config):
        for update in [] if isinstance(item, Decision) else backend.add(item):
            for each in update.decisions:
                rules[f"{each.stage}/{each.reason}"] += each.count
    backend.finish()
    backend.polish()
    return backend, rules, made


def final_error(backend, made) -> tuple[np.ndarray, np.ndarray]:
    """Of the newest pose at its tangent, with the covariance that is stated."""
    newest = backend.timeline.newest
    true = gtsam.Pose3(matrix_of(made.sevens[[newest.index]])[0])
    error = gtsam.Pose3.Logmap(backend.estimate.pose(newest.pose).inverse().compose(true))
    return error, backend.estimate.covariance([newest.pose])


@pytest.mark.parametrize("baseline", [0.0, 0.3], ids=["mono", "stereo"])
def test_wrong_sightings_do_not_get_in(baseline):
    """One in ten is of something else: nine tenths of these are refused or removed, and the pose stays as good as stated."""
    backend, rules, made = replayed(3, poses=60, stereo_baseline=baseline, wrong_feature_rate=0.1)
    sent = sum(len(each.content.ids) for each in made.sent if each.topic == "/features")
    refused = sum(
        rules[rule] for rule in ("pixels/outlier", "pixels/disagrees", "points/outlier", "points/behind")
    )
    assert refused > 0.06 * sent
    error, covariance = final_error(backend, made)
    assert error @ np.linalg.solve(covariance, error) < 30
    assert np.linalg.norm(error[3:]) < 0.5


def test_the_same_measurements_give_the_same_numbers():
    first, second = (replayed(5, poses=25, wrong_feature_rate=0.05)[0] for _ in range(2))
    for key in first.solver.factors["gauge/1700000000.000000000/0"].keys:
        assert value_in(first.space, first.estimate.values(), key).equals(
            value_in(second.space, second.estimate.values(), key), 0.0
        )
    np.testing.assert_array_equal(first.snapshot().trajectory.sevens, second.snapshot().trajectory.sevens)
    np.testing.assert_array_equal(first.snapshot().landmarks, second.snapshot().landmarks)


@pytest.mark.slow
@pytest.mark.parametrize("baseline", [0.0, 0.3], ids=["mono", "stereo"])
def test_the_pose_is_as_certain_as_it_says(baseline):
    """Mean NEES of the last pose over 200 flights, within the 99.9 % bounds of a chi-square with 6 degrees of freedom; from below, of
    what odometry alone has there: 5.5, as it is simulated a little better than its model says.
    """
    runs, sums = 200, []
    for seed in range(runs):
        backend, _, made = replayed(seed, poses=30, stereo_baseline=baseline)
        error, covariance = final_error(backend, made)
        sums.append(error @ np.linalg.solve(covariance, error))
    bound = 3.2905 * np.sqrt(2 * 6 / runs)
    assert 5.5 - bound < np.mean(sums) < 6.0 + bound
