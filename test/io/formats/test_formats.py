"""The table of formats: told by content, written by extension, converted with a word about what is lost."""

import subprocess
import sys

import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.io.formats import FORMATS, convert, format_of, g2o, read_graph, read_trajectory, write_graph
from slam_backend.io.formats.posegraph import Edges, PoseGraph

EDGE = "EDGE_SE2 0 1 1 0 0.5 10 1 2 20 3 30"
EDGE3 = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 8 0 0 0 0 0 8 0 0 0 0 8 0 0 0 8 0 0 8 0 8"


def test_every_format_reads_and_writes():
    for form in FORMATS:
        assert callable(form.module.read)
        assert callable(form.module.write)


def test_listing_the_formats_imports_none_of_them():
    code = "import sys, slam_backend.io.formats as f; f.FORMATS; print([m for m in sys.modules if m.startswith('slam_backend.io.formats.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("line", "name"),
    [
        (EDGE, "g2o"), (EDGE3, "g2o"), ("VERTEX_SE2 0 0 0 0", "g2o"), ("EDGE2 0 1 1 0 0 1 0 1 1 0 0", "toro"),
        ("VERTEX3 0 0 0 0 0 0 0", "toro"), ("VERTEX_SE2 0.0 A0 0 0 0", "pyfg"), ("VERTEX_XY L0 1 2", "pyfg"),
        ("VERTEX_XY 4 1 2", "g2o"), ("EDGE_RANGE 0 A0 L0 3 1", "pyfg"), ("1.5 0 0 0 0 0 0 1", "tum"),
        ("1 0 0 0 0 1 0 0 0 0 1 0", "kitti"), ("#timestamp [ns], a, b, c, d, e, f, g", "euroc"),
        ("17, 0, 0, 0, 1, 0, 0, 0", "euroc"), ("stamp_ns,x,y,z,qx,qy,qz,qw", "csv"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("extension", [".txt", ".csv", ".g2o", ""])
def test_the_content_tells_the_format_whatever_the_name(file, line, name, extension):
    assert format_of(file(f"a{extension}", "# something", "", line)).name == name


def test_a_file_of_no_known_content_is_what_its_extension_says_and_txt_says_nothing(file):
    assert format_of(file("a.tum", "1 2 3")).name == "tum"
    with pytest.raises(BadFile, match=r"a\.txt: is none of g2o"):
        format_of(file("a.txt", "1 2 3"))


def test_a_trajectory_is_no_graph_and_says_so(file, tmp_path):
    path = file("a.txt", "0 0 0 0 0 0 0 1")
    with pytest.raises(BadFile, match=r"holds a trajectory \(tum\), not a pose graph"):
        read_graph(path)
    with pytest.raises(BadFile, match="a trajectory has no edges"):
        convert(path, tmp_path / "b.g2o")
    assert not (tmp_path / "b.g2o").exists()


@pytest.mark.parametrize("target", ["b.pdf", "b"])
def test_a_target_of_no_known_extension_is_refused_with_the_known_ones(file, tmp_path, target):
    with pytest.raises(BadFile, match=r"end it in \.g2o"):
        convert(file("a.g2o", EDGE), tmp_path / target)


def test_a_graph_is_not_written_under_a_trajectorys_name(file, tmp_path):
    with pytest.raises(BadFile, match=r"end it in \.g2o, \.graph, \.toro, \.pyfg$"):
        write_graph(tmp_path / "b.tum", read_graph(file("a.g2o", EDGE)))


def test_g2o_through_toro_and_back_is_the_same_graph(shared, tmp_path):
    convert(shared / "pgo_sesync/intel.g2o", tmp_path / "b.graph")
    convert(tmp_path / "b.graph", tmp_path / "c.g2o")
    graph, again = read_graph(shared / "pgo_sesync/intel.g2o"), read_graph(tmp_path / "c.g2o")
    assert np.array_equal(graph.states, again.states)
    assert np.array_equal(graph.edges.states, again.edges.states)
    np.testing.assert_allclose(graph.edges.information, again.edges.information, rtol=1e-12, atol=1e-9)


def test_convert_says_what_it_did_and_what_was_lost(shared, tmp_path):
    text = convert(shared / "pyfg_cora/plaza1.pyfg", tmp_path / "b.g2o")
    assert "\n" not in text
    assert "(pyfg) ->" in text
    assert "9658 vertices, 9657 edges, 4 landmarks, 3326 ranges" in text
    assert "left out: 3326 ranges, stamps" in text
    text = convert(shared / "trajectories/evo/fr2_desk_ORB.txt", tmp_path / "b.kitti")
    assert "2893 poses; left out: stamps" in text


def test_the_vertices_of_a_graph_become_a_trajectory(shared, tmp_path):
    text = convert(shared / "pgo_sesync/intel.g2o", tmp_path / "b.tum")
    assert "left out: 2512 edges" in text
    assert "(k + 1) times 0.1 s" in text
    graph = read_graph(shared / "pgo_sesync/intel.g2o")
    assert np.array_equal(read_trajectory(tmp_path / "b.tum").sevens, graph.poses)
    with pytest.raises(BadFile, match="states no vertices"):
        convert(shared / "pgo_sesync/CSAIL.g2o", tmp_path / "c.tum")


def test_the_convention_reaches_reader_and_writer_and_is_named(file, tmp_path):
    source = file("a.g2o", EDGE3)
    text = convert(source, tmp_path / "b.pyfg", rotation_information="g2o")
    assert "3-D rotation information as g2o means it" in text
    assert np.diag(read_graph(tmp_path / "b.pyfg").edges.information[0]).tolist() == pytest.approx(
        [2] * 3 + [8] * 3
    )
    convert(source, tmp_path / "c.g2o", rotation_information="g2o")
    assert np.diag(g2o.read(tmp_path / "c.g2o").edges.information[0]).tolist() == [8] * 6


def test_what_is_not_finite_is_not_written(tmp_path):
    ids, ends = np.arange(2, dtype=np.uint64), (np.array([0]), np.array([1]))
    graph = PoseGraph("2d", ids, np.zeros((2, 3)), Edges(*ends, np.array([[1, np.inf, 0]]), np.eye(3)[None]))
    with pytest.raises(BadFile, match="EDGE_SE2 0 1: is not finite"):
        write_graph(tmp_path / "b.g2o", graph)
    assert not (tmp_path / "b.g2o").exists()


def test_a_target_that_cannot_be_written_is_named(file, tmp_path):
    with pytest.raises(BadFile, match=r"b\.g2o: cannot be written: No such file or directory"):
        convert(file("a.g2o", EDGE), tmp_path / "nowhere" / "b.g2o")
