"""PyFG files: names, stamps, covariances, ranges."""

import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.io.formats import pyfg, read_graph, write_graph
from slam_backend.io.formats.posegraph import name_of

SIZES = {  # vertices, edges, landmarks, sightings, ranges
    "pyfg_cora/factor_graph_small.pyfg": (6, 5, 1, 0, 5),
    "pyfg_cora/plaza1.pyfg": (9658, 9657, 4, 0, 3326),
    "pyfg_cora/single_drone.pyfg": (1754, 1753, 1, 0, 1754),
    "pyfg_cora/mrclam/range_and_rpm/mrclam3b/mrclam3b.pyfg": (6271, 6266, 15, 7574, 1276),
}
SMALL = (
    "VERTEX_SE2 0.1 A0 0 0 0", "VERTEX_SE2 0.2 A1 1 0 0.1", "VERTEX_SE2 0.2 B0 5 0 0.1", "VERTEX_XY L7 3 4",
    "VERTEX_SE2:PRIOR 0.1 A0 0 0 0 0.01 0 0 0.01 0 0.02", "VERTEX_XY:PRIOR 0 L7 3 4.5 0.1 0.01 0.3",
    "EDGE_SE2 0.2 A0 A1 1 0 0.1 0.01 0.001 0.002 0.03 0.003 0.05", "EDGE_SE2_XY 0.2 A1 L7 2 4 0.1 0.02 0.3",
    "EDGE_RANGE 0.2 A1 L7 4.5 0.25", "EDGE_RANGE 0.2 A1 B0 4 0.25",
)  # fmt: skip


@pytest.mark.parametrize("name", SIZES)
def test_public_graphs_have_the_sizes_that_their_lines_have(shared, name):
    graph = read_graph(shared / name)
    assert SIZES[name] == tuple(
        map(len, (graph.ids, graph.edges, graph.landmarks, graph.sightings, graph.ranges))
    )
    assert graph.notes == ()


@pytest.mark.parametrize("name", SIZES)
def test_reading_what_was_written_gives_the_same_bits(shared, tmp_path, same, name):
    graph = read_graph(shared / name)
    assert write_graph(tmp_path / "b.pyfg", graph) == ()
    same(graph, read_graph(tmp_path / "b.pyfg"))


@pytest.mark.parametrize("name", ["goats_15.pyfg", "goats_16.pyfg"])
def test_the_files_in_gtsams_wheel_survive_to_the_bit(shipped, tmp_path, same, name):
    graph = read_graph(shipped / name)
    write_graph(tmp_path / "b.pyfg", graph)
    same(graph, read_graph(tmp_path / "b.pyfg"))


def test_every_kind_of_line_is_read_and_survives(file, tmp_path, same):
    graph = pyfg.read(file("a.pyfg", *SMALL))
    assert [name_of(identifier) for identifier in graph.ids.tolist()] == ["A0", "A1", "B0"]
    assert graph.stamps.tolist() == [100_000_000, 200_000_000, 200_000_000]
    assert graph.ranges.to_landmark.tolist() == [True, False]
    assert (graph.ranges.i.tolist(), graph.ranges.j.tolist()) == ([1, 1], [0, 2])
    assert (len(graph.priors), len(graph.landmark_priors)) == (1, 1)
    pyfg.write(tmp_path / "b.pyfg", graph)
    same(graph, pyfg.read(tmp_path / "b.pyfg"))


def test_information_is_the_inverse_of_the_stated_covariance(file):
    edges = pyfg.read(file("a.pyfg", *SMALL)).edges
    stated = np.array([[0.01, 0.001, 0.002], [0.001, 0.03, 0.003], [0.002, 0.003, 0.05]])
    assert np.array_equal(edges.covariance[0], stated)
    np.testing.assert_allclose(edges.information[0] @ stated, np.eye(3), atol=1e-12)


def test_rotation_comes_first_in_3d_information(shared):
    edges = read_graph(shared / "pyfg_cora/single_drone.pyfg").edges
    np.testing.assert_allclose(np.diag(edges.information[0]), [2000] * 3 + [100] * 3)


def test_stamps_are_decimal_text_not_floats(file):
    graph = pyfg.read(file("a.pyfg", "VERTEX_SE2 1675054472.123456789 A0 0 0 0"))
    assert graph.stamps.tolist() == [1675054472123456789]


def test_a_g2o_graph_becomes_pyfg_with_names_and_stamps_by_rank(shared, tmp_path):
    graph = read_graph(shared / "pgo_sesync/intel.g2o")
    write_graph(tmp_path / "b.pyfg", graph)
    again = read_graph(tmp_path / "b.pyfg")
    assert again.stamps[:2].tolist() == [100_000_000, 200_000_000]
    assert np.array_equal(again.states, graph.states)
    np.testing.assert_allclose(again.edges.information, graph.edges.information, rtol=1e-9, atol=1e-6)


def test_a_singular_information_has_no_covariance_to_write(file, tmp_path):
    graph = read_graph(file("a.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 0"))
    with pytest.raises(BadFile, match="EDGE_SE2 A0 A1: its information matrix is singular"):
        write_graph(tmp_path / "b.pyfg", graph)
    assert not (tmp_path / "b.pyfg").exists()


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("EDGE_SE2 0.2 A0 A9 1 0 0.1 1 0 0 1 0 1", "A9 has no VERTEX line"),
        ("EDGE_SE2 0.2 A0 17 1 0 0.1 1 0 0 1 0 1", "17: is not a name"),
        ("EDGE_SE2 soon A0 A1 1 0 0.1 1 0 0 1 0 1", "soon: is not a time"),
        ("EDGE_SE2 0.2 A0 A1 1 0 0.1 0 0 0 1 0 1", "covariance matrix is singular"),
        ("EDGE_SE2 0.2 A0 A1 1 0 0.1 -1 0 0 1 0 1", "covariance matrix is indefinite"),
        ("EDGE_RANGE 0.2 A0 L8 4 0.25", "L8 has no VERTEX line"),
        ("EDGE_RANGE 0.2 A0 L7 -4 0.25", "its range is negative"),
        ("EDGE_RANGE 0.2 A0 L7 4 0", "its variance is not positive"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(file, line, complaint):
    with pytest.raises(BadFile, match=rf"a\.pyfg:11: .*{complaint}"):
        pyfg.read(file("a.pyfg", *SMALL, line))
