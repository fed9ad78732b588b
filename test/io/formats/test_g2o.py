"""g2o files: the same graph as gtsam's own reader makes, and the same bits after writing and reading."""

import time

import gtsam
import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.io.formats import g2o, read_graph, write_graph

COUNTS = {
    "pgo_sesync/tinyGrid3D.g2o": (9, 11),
    "pgo_sesync/smallGrid3D.g2o": (125, 297),
    "pgo_sesync/sphere2500.g2o": (2500, 4949),
    "pgo_sesync/parking-garage.g2o": (1661, 6275),
    "pgo_sesync/CSAIL.g2o": (1045, 1172),
    "pgo_sesync/MIT.g2o": (808, 827),
    "pgo_sesync/intel.g2o": (1728, 2512),
    "pgo_sesync/city10000.g2o": (10000, 20687),
    "pgo_carlone2d/M3500.g2o": (3500, 5453),
    "pgo_carlone2d/M3500a.g2o": (3500, 5453),
    "pgo_carlone2d/M3500b.g2o": (3500, 5453),
    "pgo_carlone2d/M3500c.g2o": (3500, 5453),
    "pgo_carlone2d/INTEL.g2o": (1228, 1483),
    "pgo_glc/duderstadt.g2o": (545, 1800),
    "pgo_vertigo/ring/originalDataset/ring.g2o": (434, 459),
    "pgo_vertigo/manhattan/originalDataset/Olson/manhattanOlson3500.g2o": (3500, 5598),
    "pgo_vertigo/manhattan/originalDataset/g2o/manhattanOlson3500.g2o": (3500, 5598),
    "pgo_vertigo/newcollege/newcollege_short.g2o": (633, 694),
    "pgo_kimera_rpgo/ordered.g2o": (140, 153),
    "pgo_kimera_rpgo/unordered.g2o": (140, 153),
    "pgo_kimera_rpgo/robot_a.g2o": (50, 52),
    "pgo_kimera_rpgo/robot_b.g2o": (42, 43),
}


def factors_of(graph):
    """The graph as gtsam factors over the file's own ids."""
    made = gtsam.NonlinearFactorGraph()
    planar = graph.space == "2d"
    kind = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    for n, (i, j) in enumerate(zip(graph.ids[graph.edges.i], graph.ids[graph.edges.j], strict=True)):
        noise = gtsam.noiseModel.Gaussian.Information(graph.edges.information[n])
        pose = pose_of(graph.edges.states[n] if planar else graph.edges.poses[n])
        made.add(kind(int(i), int(j), pose, noise))
    return made


def pose_of(state):
    if len(state) == 3:
        return gtsam.Pose2(*state)
    return gtsam.Pose3(gtsam.Rot3(state[6], *state[3:6]), state[:3])


def costs(factors, values):
    return np.array([factors.at(n).error(values) for n in range(factors.size())])


@pytest.mark.parametrize("name", COUNTS)
def test_public_graphs_have_the_vertices_and_edges_that_are_known_of_them(shared, name):
    graph = read_graph(shared / name)
    assert (len(graph.ids), len(graph.edges)) == COUNTS[name]
    assert graph.notes == ()


@pytest.mark.parametrize("name", [name for name in COUNTS if "kimera" not in name and "CSAIL" not in name])
def test_every_factor_costs_what_it_costs_through_gtsams_reader(shared, name):
    """Each factor at the file's own vertices and a little beside them, to 1e-12 of the largest."""
    graph = read_graph(shared / name)
    theirs, values = gtsam.readG2o(str(shared / name), graph.space == "3d")
    ours = factors_of(graph)
    assert [list(ours.at(n).keys()) for n in range(ours.size())] == [
        list(theirs.at(n).keys()) for n in range(theirs.size())
    ]
    rng = np.random.default_rng(1)
    planar = graph.space == "2d"
    for identifier, state in zip(graph.ids.tolist(), graph.states if planar else graph.poses, strict=True):
        pose, theirs_says = pose_of(state), values.atPose2 if planar else values.atPose3
        assert theirs_says(identifier).equals(pose, 1e-12)
        values.update(identifier, pose.retract(rng.normal(0, 0.1, 3 if planar else 6)))
    expected = costs(theirs, values)
    np.testing.assert_allclose(costs(ours, values), expected, rtol=1e-12, atol=1e-12 * expected.max())


@pytest.mark.parametrize("name", COUNTS)
def test_reading_what_was_written_gives_the_same_bits(shared, tmp_path, same, name):
    graph = read_graph(shared / name)
    assert write_graph(tmp_path / "copy.g2o", graph) == ()
    same(graph, read_graph(tmp_path / "copy.g2o"))


@pytest.mark.parametrize("convention", ["gtsam", "g2o"])
def test_both_meanings_of_rotation_information_survive_writing_to_the_bit(shared, tmp_path, same, convention):
    graph = g2o.read(shared / "pgo_sesync/parking-garage.g2o", convention)
    g2o.write(tmp_path / "copy.g2o", graph, convention)
    same(graph, g2o.read(tmp_path / "copy.g2o", convention))


def test_information_of_half_the_angle_is_a_quarter_for_rotation_and_half_where_it_meets_translation(file):
    path = file("a.g2o", "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 8 0 0 1 0 0 8 0 0 0 0 8 0 0 2 8 0 0 8 0 8")
    plain, half = (g2o.read(path, convention).edges.information[0] for convention in ("gtsam", "g2o"))
    assert np.diag(plain).tolist() == [8] * 6
    assert (plain[0, 3], plain[2, 5]) == (1, 2)  # rotation first: x with rx, z with rz
    assert np.diag(half).tolist() == [2, 2, 2, 8, 8, 8]
    assert (half[0, 3], half[2, 5]) == (0.5, 1)


def test_half_the_angle_is_what_g2os_error_measures():
    """With the information divided, GTSAM's cost of a small rotation is that of the quaternion's vector part."""
    angle, information = 1e-4, np.diag([400.0, 400.0, 400.0, 10, 10, 10])
    weights = np.outer(g2o.HALF_ANGLE, g2o.HALF_ANGLE)
    noise = gtsam.noiseModel.Gaussian.Information(information * weights)
    factor = gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(gtsam.Rot3.Rz(angle), np.zeros(3)))
    assert factor.error(values) == pytest.approx(0.5 * 400 * np.sin(angle / 2) ** 2, rel=1e-6)


def test_a_file_without_vertex_lines_has_ids_but_no_poses(shared):
    graph = read_graph(shared / "pgo_sesync/CSAIL.g2o")
    assert graph.states is None
    assert graph.poses is None
    assert graph.ids.tolist() == list(range(1045))


def test_robot_keys_of_64_bits_are_kept_exactly(file, shared):
    """The two here differ by less than a float could tell."""
    keys = [7061644215716937728, 7061644215716937729]
    graph = g2o.read(file("a.g2o", f"EDGE_SE2 {keys[1]} {keys[0]} 1 2 0.5 1 0 0 1 0 1"))
    assert graph.ids.tolist() == keys
    lines = (shared / "pgo_kimera_rpgo/ordered.g2o").read_text().splitlines()
    stated = sorted(int(line.split()[1]) for line in lines if line.startswith("VERTEX"))
    assert read_graph(shared / "pgo_kimera_rpgo/ordered.g2o").ids.tolist() == stated


def test_an_edge_from_newer_to_older_stays_as_it_is(file):
    graph = g2o.read(file("a.g2o", "EDGE_SE2 7 3 1 2 0.5 1 0 0 1 0 1"))
    assert graph.ids.tolist() == [3, 7]
    assert (graph.edges.i.tolist(), graph.edges.j.tolist()) == ([1], [0])
    assert graph.edges.states.tolist() == [[1, 2, 0.5]]


def test_quaternions_of_any_length_are_kept_as_stated_and_normalized_for_use(file, tmp_path):
    graph = g2o.read(file("a.g2o", "VERTEX_SE3:QUAT 0 1 2 3 0 0 0 2", "VERTEX_SE3:QUAT 1 1 2 3 0 0 3 4"))
    assert graph.states[:, 3:].tolist() == [[0, 0, 0, 2], [0, 0, 3, 4]]
    np.testing.assert_allclose(graph.poses[:, 3:], [[0, 0, 0, 1], [0, 0, 0.6, 0.8]], atol=1e-15)


def test_comments_and_blank_lines_count_as_lines_but_hold_nothing(file):
    path = file("a.g2o", "# a map", "", "VERTEX_SE2 0 0 0 0  # the start", "FIX 0", "VERTEX_SE2 1 0 0 x")
    with pytest.raises(BadFile, match=r"a\.g2o:5: x: is not a number"):
        g2o.read(path)


def test_planar_landmarks_and_fixed_vertices_survive(file, tmp_path, same):
    path = file(
        "a.g2o", "VERTEX_SE2 0 0.1 0 0", "VERTEX_SE2 2 1 0 0.3", "VERTEX_XY 1 3 0.7", "FIX 2 0",
        "EDGE_SE2 0 2 1 0 0.3 1 0.1 0.2 1 0.3 1", "EDGE_SE2_XY 2 1 0.1 0.2 4 1 3",
    )  # fmt: skip
    graph = g2o.read(path)
    assert graph.landmarks.tolist() == [1]
    assert graph.fixed.tolist() == [1, 0]
    assert graph.sightings.information[0].tolist() == [[4, 1], [1, 3]]
    g2o.write(tmp_path / "b.g2o", graph)
    same(graph, g2o.read(tmp_path / "b.g2o"))


def test_landmarks_in_space_survive(shipped, tmp_path, same):
    graph = read_graph(shipped / "known_landmark_localization_20.g2o")
    assert (len(graph.landmarks), len(graph.sightings)) == (4, 80)
    write_graph(tmp_path / "b.g2o", graph)
    same(graph, read_graph(tmp_path / "b.g2o"))


def test_a_landmark_without_a_line_of_its_own_has_no_position_yet(shipped):
    graph = read_graph(shipped / "edge_se3_trackxyz_missing_vertex.g2o")
    assert graph.landmarks.tolist() == [9]
    assert np.isnan(graph.positions).all()


def test_a_sensors_offset_moves_its_sightings_into_the_vertex_frame(file):
    """A sensor 1 m ahead that looks to the left: what is 2 m before it lies at (1, 2)."""
    path = file(
        "a.g2o", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "PARAMS_SE3OFFSET 3 1 0 0 0 0 0.7071067811865476 0.7071067811865476",
        "EDGE_SE3_TRACKXYZ 0 9 3 2 0 0 100 0 0 1 0 1",
    )  # fmt: skip
    sightings = g2o.read(path).sightings
    np.testing.assert_allclose(sightings.states, [[1, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(sightings.information[0], np.diag([1, 100, 1]), atol=1e-12)


def test_unknown_tags_are_skipped_and_counted(shipped):
    graph = read_graph(shipped / "cityTrees_reduced_1k.g2o")
    assert len(graph.edges) == 999
    assert graph.notes == ("406 lines 'LANDMARK2' skipped (the first is line 1000)",)


def test_twenty_thousand_edges_are_read_in_half_a_second(shared):
    best = 1e9
    for _ in range(3):
        start = time.process_time()
        read_graph(shared / "pgo_sesync/city10000.g2o")
        best = min(best, time.process_time() - start)
    assert best < 0.5
