"""Data sets come out of gtsam's wheel whole: the numbers of the text are in the bag."""

import itertools
from collections import Counter
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml

from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig
from slam_backend.core.geometry import covariance_from_ros, inverse_of, matrix_of
from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors import camera, landmark, odometry, pixels, relative
from slam_backend.io.bags import open_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.formats import tum
from slam_backend.io.replay import replay
from slam_backend.lab.datasets import DATASETS, beacons, make_dataset

ROOT = Path(__file__).parents[2]


def decoded(path: Path, topic: str, decode) -> list:
    """Everything on a topic, through the decoder."""
    with open_bag(path) as bag:
        return [decode(bag.typestore.deserialize_cdr(r.data, r.type), "x") for r in bag.records({topic})]


@pytest.fixture(scope="module")
def park(tmp_path_factory) -> Path:
    return make_dataset("victoria_park", tmp_path_factory.mktemp("park") / "park.mcap").path


def test_victoria_park_has_all_poses_sightings_and_trees(park: Path) -> None:
    """6969, 3640 and 151, with the first lines of the file first."""
    poses = decoded(park, "/odom", odometry.decode_odometry)
    sightings = [seen for cloud in decoded(park, "/trees", landmark.decode_points) for seen in cloud]
    assert (len(poses), len(sightings), len({seen.landmark for seen in sightings})) == (6969, 3640, 151)
    np.testing.assert_array_equal(poses[0].pose, [0, 0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(poses[1].pose[:3], [0.000985144, -3.63222e-10, 0], atol=1e-12)
    first = sightings[0]
    assert (first.landmark, first.frame, first.stamp) == ("5", "base_link", poses[4].stamp)
    np.testing.assert_array_equal(first.value, [11.5387, -3.2007, 0])
    np.testing.assert_array_equal(first.covariance, 0.4 * np.eye(3))


def test_victoria_parks_steps_and_their_noise_come_back_from_the_accumulated_poses(park: Path) -> None:
    """Steps to 1e-9; the twist covariance times the squared period is the covariance in the file."""
    lines = Path(gtsam.findExampleDataFile("victoria_park.txt")).read_text().splitlines()
    steps = np.array([line.split()[3:6] for line in lines if line.startswith("ODOMETRY")], dtype=float)
    messages = decoded(park, "/odom", odometry.decode_odometry)
    poses = matrix_of([message.pose for message in messages])
    moved = inverse_of(poses[:-1]) @ poses[1:]
    yaw = np.arctan2(moved[:, 1, 0], moved[:, 0, 0])
    np.testing.assert_allclose(
        np.stack([moved[:, 0, 3], moved[:, 1, 3], yaw], axis=1), steps, rtol=0, atol=1e-9
    )
    for before, message in itertools.pairwise(messages):
        seconds = (message.stamp - before.stamp) / 1e9
        noise = message.twist_covariance.reshape(6, 6) * seconds**2
        np.testing.assert_allclose(np.diag(noise)[[0, 1, 5]], [1e-4, 4e-6, 4e-6], rtol=1e-12)
    np.testing.assert_allclose(np.array([m.twist[[0, 1, 5]] for m in messages[1:]]) * 0.2, steps, atol=1e-12)


def test_sightings_of_a_pose_arrive_after_its_odometry(park: Path) -> None:
    with open_bag(park) as bag:
        order = [(record.log_time, record.topic) for record in bag.records()]
    assert [time for time, _ in order] == sorted({time for time, _ in order})
    assert Counter(topic for _, topic in order) == {"/odom": 6969, "/trees": 3331}
    assert order[4][1] == "/odom"
    assert order[5][1] == "/trees"


def test_the_configuration_of_victoria_park_names_the_topics_of_its_bag(park: Path) -> None:
    config = config_from(yaml.safe_load((ROOT / "config/victoria_park.yaml").read_text()))
    with open_bag(park) as bag:
        assert {source.topic for source in config.sources.values()} == set(bag.topics)
    assert config.space == "2d"
    assert config.keyframes.every


def residuals(edges: list, truth: list) -> np.ndarray:
    """(N, 6) errors of measured edges against true poses, at the tangent of j."""
    poses = {message.stamp: gtsam.Pose3(matrix_of(message.pose)) for message in truth}
    return np.array([
        gtsam.Pose3.Logmap(
            poses[e.stamp_i].between(poses[e.stamp_j]).between(gtsam.Pose3(matrix_of(e.pose)))
        )
        for e in edges
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("name", "poses", "count"), [("sphere2500", 2500, 4949), ("city10000", 10000, 20687)]
)
def test_the_stated_noise_of_a_graph_is_what_its_edges_are_off_the_truth(
    name: str, poses: int, count: int, tmp_path
) -> None:
    """Every edge is there, and each used axis has chi-square of one per edge: the reading of the file is right."""
    made = make_dataset(name, tmp_path / "graph.mcap")
    edges = decoded(made.path, "/edges", relative.decode_odometry)
    truth = decoded(made.path, "/truth", odometry.decode_odometry)
    assert (len(edges), len(truth), made.messages) == (count, poses, count + poses)
    assert made.truth is not None
    assert len(made.truth.read_text().splitlines()) == poses
    used = slice(2, 5) if name == "city10000" else slice(0, 6)
    errors = residuals(edges, truth)[:, used]
    variances = np.array([
        np.diag(covariance_from_ros(e.covariance.reshape(6, 6), matrix_of(e.pose)[:3, :3]))[used] for e in edges
    ])  # fmt: skip
    np.testing.assert_allclose((errors**2 / variances).mean(axis=0), 1, atol=0.08)


@pytest.mark.parametrize(("name", "count"), [("sphere2500", 4949), ("city10000", 20687), ("w10000", 64311)])
def test_a_graph_comes_in_an_order_in_which_it_can_be_driven(name: str, count: int, tmp_path) -> None:
    """Each edge ends at its newer vertex; a vertex first comes with the edge from the one before."""
    edges = decoded(make_dataset(name, tmp_path / "graph.mcap").path, "/edges", relative.decode_odometry)
    assert len(edges) == count
    known = {edges[0].stamp_i}
    for edge in edges:
        assert edge.stamp == edge.stamp_j > edge.stamp_i
        assert edge.stamp_i in known
        if edge.stamp_j not in known:
            assert edge.stamp_j - edge.stamp_i == 100_000_000
        known.add(edge.stamp_j)


def test_w10000_edges_are_turned_round(tmp_path) -> None:
    """`EDGE2 1 0 -0.99879 0.0417574 -0.00818381`: pose of 0 in 1; the bag tells the pose of 1 in 0."""
    edges = decoded(make_dataset("w10000", tmp_path / "graph.mcap").path, "/edges", relative.decode_odometry)
    expected = gtsam.Pose2(-0.99879, 0.0417574, -0.00818381)
    turned = expected.inverse()
    matrix = matrix_of(edges[0].pose)
    np.testing.assert_allclose(matrix[:2, 3], turned.translation(), atol=1e-12)
    noise = covariance_from_ros(edges[0].covariance.reshape(6, 6), matrix[:3, :3])[
        np.ix_([3, 4, 2], [3, 4, 2])
    ]
    adjoint = expected.AdjointMap()
    np.testing.assert_allclose(noise, adjoint @ adjoint.T, atol=1e-12)


@pytest.mark.parametrize(("name", "count", "seconds"), [("plaza1", 9657, 1933), ("plaza2", 4090, 409)])
def test_plaza_has_the_numbers_of_the_files_beside_their_truth(
    name: str, count: int, seconds: float, tmp_path
) -> None:
    """Distances, turns and ranges come back as in the text files; progress heard of every message. The truth knows how long the
    ranges are: 7 % too long, at each beacon.
    """
    heard: list[int] = []
    made = make_dataset(name, tmp_path / "plaza.mcap", heard.append)
    ranges = np.loadtxt(gtsam.findExampleDataFile(f"{name.capitalize()}_TD.txt"))
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]  # some rows of the file are out of order
    assert made.messages == sum(heard) == count + len(ranges)
    assert abs(made.seconds - seconds) < 1
    seen = [s for cloud in decoded(made.path, "/ranges", landmark.decode_points) for s in cloud]
    np.testing.assert_allclose([item.value[0] for item in seen], ranges[:, 3])
    truth = tum.read(made.truth)
    paths = np.array(
        [np.interp([s.stamp for s in seen], truth.stamps, axis) for axis in truth.sevens.T[:2]]
    ).T
    for beacon, place in beacons(name).items():
        rows = [k for k, item in enumerate(seen) if item.landmark == beacon]
        ratios = ranges[rows, 3] / np.linalg.norm(paths[rows] - place, axis=1)
        assert 1.06 < np.median(ratios) < 1.08
    rows = np.loadtxt(gtsam.findExampleDataFile(f"{name.capitalize()}_DR.txt"))
    messages = decoded(made.path, "/odom", odometry.decode_odometry)
    poses = matrix_of([message.pose for message in messages])
    moved = inverse_of(poses[:-1]) @ poses[1:]
    np.testing.assert_allclose(moved[:, 0, 3], rows[1:, 1], atol=1e-9)
    np.testing.assert_allclose([message.stamp / 1e9 for message in messages], rows[:, 0], atol=1e-6)


def test_an_unknown_data_set_is_refused_with_the_known_ones(tmp_path) -> None:
    with pytest.raises(BadConfig, match=", ".join(DATASETS)):
        make_dataset("moon", tmp_path / "x.mcap")


def test_kitti_has_an_imu_and_fixes_and_its_configuration_finds_yaw_and_speed(tmp_path: Path) -> None:
    """The first minute: the car moves when it begins, and nobody says where it looks."""
    made = make_dataset("kitti_imu_gnss", tmp_path / "kitti.mcap")
    assert made.messages == 46_968 + 470
    run = replay(made.path, load_config(ROOT / "config/kitti_imu_gnss.yaml"), ("gps.withhold=[[30, 472]]",))
    for update in run:
        if update.keyframe.stamp > 46_565 * SECOND:
            break
    backend = run.backend
    found = backend.compared(backend.snapshot())
    inside = (found.stamps > 46_550 * SECOND) & ~np.isnan(found.antennas[:, 0])
    away = np.linalg.norm((found.antennas - found.fixes)[inside, :2], axis=1)
    assert len(away) > 10
    assert away.max() < 0.3


def test_the_fixes_of_kitti_alone_make_a_path_near_those_kept_back(tmp_path: Path) -> None:
    """A fix each second, at up to 14 m/s; every tenth is a truth."""
    path = make_dataset("kitti_imu_gnss", tmp_path / "kitti.mcap").path
    gps = {"kind": "gnss", "topic": "/fix", "withhold_every": 10}
    run = replay(path, config_from({"space": "2d", "sources": ["gps"], "gps": gps}))
    for _ in run:
        pass
    found = run.backend.compared(run.backend.snapshot())
    away = np.linalg.norm((found.antennas - found.fixes)[:, :2], axis=1)
    assert found.withheld.sum() == 47
    assert np.sqrt(np.mean(away[~found.withheld] ** 2)) < 0.2
    assert np.nanmedian(away[found.withheld]) < 1.0


def test_kitti_stereo_has_every_sighting_and_the_right_cameras_baseline(tmp_path: Path) -> None:
    """52544 of 15638 features in 77 images, as the text has them: u left, u right, v."""
    path = make_dataset("kitti_stereo", tmp_path / "stereo.mcap").path
    frames = decoded(path, "/features", pixels.decode)
    assert len(frames) == 77
    assert sum(len(frame.ids) for frame in frames) == 52_544
    assert len({number for frame in frames for number in frame.ids.tolist()}) == 15_638
    assert (frames[0].ids[0], *frames[0].pixels[0]) == (7, 322.497, 11.6692, 299.487)
    info = decoded(path, "/camera_right/camera_info", camera.decode_info)[0]
    assert info.rectified == (718.856, 718.856, 607.1928, 185.2157, pytest.approx(0.5371657189))


@pytest.mark.slow
def test_kitti_stereo_ends_at_the_optimum_that_gtsam_finds(tmp_path: Path) -> None:
    """7399.0425 with every sighting let in, the first camera fixed."""
    path = make_dataset("kitti_stereo", tmp_path / "stereo.mcap").path
    config = load_config(ROOT / "config/kitti_stereo.yaml")
    every = ("features.probability=1", "features.share=10")
    summary = replay(path, config, every, final="batch").result.summary
    assert summary["counts"]["landmarks"] == 15_638
    assert summary["cost"]["final"] == pytest.approx(7399.0425, rel=1e-3)
    assert not any(rule.startswith(("pixels/", "points/")) for rule in summary["decisions"])
