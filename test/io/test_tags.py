"""Tags with an orientation in what a run leaves behind: landmarks.csv, queries, the graph file, the saved map, the report."""

import csv

import numpy as np
import pytest

from slam_backend.core.config import config_from
from slam_backend.core.measurement import SECOND
from slam_backend.core.query import answers
from slam_backend.core.space import SPACES
from slam_backend.io.bags import write_bag
from slam_backend.io.encode import encode_cloud, encode_odometry
from slam_backend.io.finished import FinishedRun
from slam_backend.io.formats import read_graph
from slam_backend.io.mapfile import read_map
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.report import write_report
from slam_backend.lab.report.subject import Subject

TAG = {"2d": (6.0, 2.0, 0.0, 0.0, 0.0, 2.5), "3d": (6.0, 2.0, 1.0, 0.3, -0.2, 2.5)}
NOISE = np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]) ** 2
NAME = "tag36h11:5"


@pytest.fixture(scope="module", params=["2d", "3d"])
def run(request, tmp_path_factory):
    """Six metres past a tag and a tree, both seen from each keyframe."""
    space, folder = SPACES[request.param], tmp_path_factory.mktemp(request.param)
    tag, tree = space.from_extrinsics(TAG[space.name]), np.array([3.0, -2.0, 0.5])[: space.point_dimension]
    records = []
    for n in range(7):
        stamp, base = (n + 1) * SECOND, space.from_extrinsics((n, 0, 0, 0, 0, 0.1 * n))
        seen, point = space.seven(base.inverse().compose(tag)), np.zeros(3)
        point[: space.point_dimension] = base.transformTo(tree)
        nothing = (np.zeros(6), np.zeros(36))
        odometry = encode_odometry(stamp, "odom", "base", space.seven(base), np.zeros(36), *nothing)
        sighting = encode_odometry(stamp, "base", NAME, seen, NOISE.ravel(), *nothing)
        cloud = {"id": np.array([3], dtype=np.uint32), **dict(zip("xyz", point[:, None], strict=True))}
        records += [
            Record("/tags", "nav_msgs/msg/Odometry", stamp, sighting),
            Record("/trees", "sensor_msgs/msg/PointCloud2", stamp, encode_cloud(stamp, "base", cloud)),
            Record("/odom", "nav_msgs/msg/Odometry", stamp, odometry),
        ]
    write_bag(folder / "drive.mcap", records)
    config = config_from({
        "space": space.name, "keyframes": {"every": True}, "sources": ["odom", "tags", "trees"],
        "odom": {"kind": "odometry", "topic": "/odom"}, "tags": {"kind": "landmark", "topic": "/tags"},
        "trees": {"kind": "landmark", "topic": "/trees"},
    })  # fmt: skip
    result = replay(folder / "drive.mcap", config).result
    write_run(result, folder / "run")
    return result, folder / "run", tag


def test_landmarks_csv_has_the_orientation_of_the_tag_and_none_of_the_tree(run):
    result, out, tag = run
    space = result.run.backend.space
    rows = {row["id"]: row for row in csv.DictReader((out / "landmarks.csv").open())}
    assert {name: row["kind"] for name, row in rows.items()} == {NAME: "pose", "3": "point"}
    told = [float(rows[NAME][column]) for column in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    np.testing.assert_allclose(told, space.seven(tag), atol=1e-6)
    assert [rows["3"][column] for column in ("qx", "qy", "qz", "qw")] == [""] * 4
    assert rows[NAME]["observations"] == rows["3"]["observations"] == "7"


def test_the_covariance_in_landmarks_csv_is_about_the_axes_of_the_map(run):
    """The tag's own tangent is turned by 2.5 rad; from seven sightings with 1 cm along x it is known better than that."""
    result, out, tag = run
    backend = result.run.backend
    mine = FinishedRun(out).landmark_covariances[result.snapshot.names.index(NAME)]
    tangent = backend.estimate.covariance([backend.landmark(NAME)])
    place = backend.space.translation
    turn = tag.rotation().matrix()
    size = backend.space.point_dimension
    np.testing.assert_allclose(
        mine[:size, :size], turn @ tangent[place, place] @ turn.T, rtol=1e-5, atol=1e-12
    )


def test_a_query_tells_the_whole_pose_of_the_tag_and_the_position_of_the_tree(run):
    result, out, tag = run
    of_tag, of_tree = answers([f"landmark/{NAME}", "landmark/3"], FinishedRun(out))
    np.testing.assert_allclose(of_tag.value, result.run.backend.space.seven(tag), atol=1e-6)
    assert of_tree.value.shape == (3,)


def test_the_graph_file_has_the_tree_and_no_tag(run):
    """No format has landmarks with an orientation; what it has can be solved again."""
    _, out, _ = run
    graph = read_graph(out / "graph.g2o")
    assert (len(graph.landmarks), len(graph.sightings.i)) == (1, 7)
    assert len(replay(out / "graph.g2o").result.trajectory) == 7


def test_the_saved_map_keeps_the_tag(run):
    result, out, tag = run
    key = result.run.backend.landmark(NAME)
    saved = read_map(out)
    assert saved.landmarks[NAME] == key
    assert result.run.backend.space.pose_in(saved.values, key).equals(tag, 1e-6)
    pose, seen = saved.sighted[key]
    assert result.run.backend.space.pose_in(saved.values, pose).compose(seen).equals(tag, 1e-3)


def test_the_report_draws_both(run, tmp_path):
    _, out, _ = run
    write_report(Subject(out), tmp_path / "report.html")
    assert "2 landmarks" in (tmp_path / "report.html").read_text()
