"""TORO files: its own order of the information, and the orders that others wrote under its tags."""

import gtsam
import numpy as np
import pytest

from slam_backend.io.formats import g2o, read_graph, toro, write_graph


def test_toros_order_is_xx_xy_yy_tt_xt_yt(file):
    edges = toro.read(file("a.graph", "EDGE2 0 1 1 2 0 10 1 20 30 2 3")).edges
    assert edges.information[0].tolist() == [[10, 1, 2], [1, 20, 3], [2, 3, 30]]


def test_the_toro_copy_of_csail_is_the_g2o_file(shared):
    toro_graph = read_graph(shared / "pgo_toro2d/CSAIL_P_toro.graph")
    g2o_graph = read_graph(shared / "pgo_sesync/CSAIL.g2o")
    assert len(toro_graph.ids) == 1045
    for name in ("i", "j"):
        assert np.array_equal(getattr(toro_graph.edges, name), getattr(g2o_graph.edges, name))
    np.testing.assert_allclose(toro_graph.edges.states, g2o_graph.edges.states, atol=1e-5)
    np.testing.assert_allclose(
        toro_graph.edges.information, g2o_graph.edges.information, rtol=1e-4, atol=1e-2
    )


@pytest.mark.parametrize("name", ["w100.graph", "w10000.graph"])
def test_planar_files_survive_to_the_bit(shipped, tmp_path, same, name):
    graph = read_graph(shipped / name)
    assert "EQUIV" in graph.notes[0]
    write_graph(tmp_path / "b.graph", graph)
    same(graph, read_graph(tmp_path / "b.graph"))


def test_information_that_is_turned_survives_to_the_last_digits(shared, tmp_path, same):
    """TORO's stands along the axes of the first vertex, ours along those of the second."""
    graph = read_graph(shared / "pgo_toro2d/CSAIL_P_toro.graph")
    write_graph(tmp_path / "b.graph", graph)
    again = read_graph(tmp_path / "b.graph")
    same(graph, again, but=("edges.information",))
    scale = np.abs(graph.edges.information).max(axis=(1, 2), keepdims=True)
    assert np.abs((again.edges.information - graph.edges.information) / scale).max() < 1e-14


def test_information_row_by_row_under_toros_tags_is_recognized_and_said(shipped):
    graph = read_graph(shipped / "w100_30.g2o")
    assert np.array_equal(graph.edges.information, np.tile(np.eye(3), (59, 1, 1)))
    assert "not TORO's own" in graph.notes[0]
    graph = read_graph(shipped / "w20000.txt")
    assert np.diag(graph.edges.information[0]).tolist() == [3.16228, 3.16228, 5]


def test_planar_edges_cost_what_they_cost_through_gtsams_reader(shipped):
    graph = read_graph(shipped / "w100.graph")
    theirs, values = gtsam.load2D(str(shipped / "w100.graph"))
    for n in range(theirs.size()):
        i, j = graph.ids[graph.edges.i[n]], graph.ids[graph.edges.j[n]]
        noise = gtsam.noiseModel.Gaussian.Information(graph.edges.information[n])
        ours = gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*graph.edges.states[n]), noise)
        assert ours.error(values) == pytest.approx(theirs.at(n).error(values), rel=1e-12)


def test_roll_pitch_yaw_gives_the_rotation_that_gtsam_makes_of_it(file):
    rng = np.random.default_rng(3)
    angles = rng.uniform(-1.5, 1.5, (50, 3))
    lines = [f"VERTEX3 {n} 0 0 0 {r!r} {p!r} {y!r}" for n, (r, p, y) in enumerate(angles.tolist())]
    poses = toro.read(file("a.graph", *lines)).poses
    for (roll, pitch, yaw), pose in zip(angles, poses, strict=True):
        R = gtsam.Rot3(pose[6], *pose[3:6]).matrix()
        np.testing.assert_allclose(R, gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix(), atol=1e-14)


def test_3d_information_has_translation_first_as_its_g2o_copy_says(shared, shipped):
    """sphere2500 exists in both; the g2o copy has four times the rotation's information, that of half the angle."""
    euler = read_graph(shipped / "sphere2500.txt")
    quaternion = g2o.read(shared / "pgo_sesync/sphere2500.g2o", "g2o")
    orders = [np.lexsort((graph.edges.i, graph.edges.j)) for graph in (euler, quaternion)]
    a, b = (graph.edges.poses[order] for graph, order in zip((euler, quaternion), orders, strict=True))
    np.testing.assert_allclose(np.abs(a), np.abs(b), atol=1e-4)
    for got, expected in ((euler, [100, 100, 25, 10, 10, 10]), (quaternion, [100, 100, 25, 10, 10, 10])):
        np.testing.assert_allclose(
            np.median(np.diagonal(got.edges.information, 0, 1, 2), 0), expected, rtol=0.02
        )


def test_3d_files_survive_through_roll_pitch_yaw(shipped, tmp_path):
    graph = read_graph(shipped / "sphere_smallnoise.graph")
    assert graph.notes == ("the edges state no information: taken as the identity",)
    write_graph(tmp_path / "b.graph", graph)
    again = read_graph(tmp_path / "b.graph")
    assert np.array_equal(again.edges.information, graph.edges.information)
    for a, b in ((graph.poses, again.poses), (graph.edges.poses, again.edges.poses)):
        np.testing.assert_allclose(a[:, :3], b[:, :3], atol=0)
        np.testing.assert_allclose(np.abs((a[:, 3:] * b[:, 3:]).sum(1)), 1, atol=1e-12)


def test_what_toro_cannot_say_is_returned_in_words(shipped, tmp_path):
    graph = read_graph(shipped / "known_landmark_localization_3.g2o")
    assert write_graph(tmp_path / "b.graph", graph) == ("4 landmarks", "12 sightings")
