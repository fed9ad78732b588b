"""Whatever a file holds: it is read, or one BadFile line names the file, the line and the words. Nothing else, ever."""

import random
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slam_backend.core.errors import BadFile
from slam_backend.io.formats import FORMATS, read_graph, read_trajectory
from slam_backend.io.formats.posegraph import measurements

UNIT2, UNIT3 = "1 0 0 1 0 1", "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
GOOD = {
    "planar.g2o": ("VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0.5", "VERTEX_XY 2 1 1", "FIX 0",
                   f"EDGE_SE2 0 1 1 0 0.5 {UNIT2}", "EDGE_SE2_XY 1 2 1 1 1 0 1"),
    "space.g2o": ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 1 0 0 0 0 0.6 0.8", "VERTEX_TRACKXYZ 2 1 1 1",
                  "PARAMS_SE3OFFSET 0 0 0 0.1 0 0 0 1", f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.6 0.8 {UNIT3}",
                  "EDGE_SE3_TRACKXYZ 0 2 0 1 1 1 1 0 0 1 0 1"),
    "planar.graph": ("VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0.5", "EDGE2 0 1 1 0 0.5 10 1 20 30 2 3"),
    "space.graph": ("VERTEX3 0 0 0 0 0 0 0", "VERTEX3 1 1 0 0 0 0 1", f"EDGE3 0 1 1 0 0 0 0 1 {UNIT3}"),
    "a.pyfg": ("VERTEX_SE2 0.1 A0 0 0 0", "VERTEX_SE2 0.2 A1 1 0 0.1", "VERTEX_XY L7 3 4", f"VERTEX_SE2:PRIOR 0.1 A0 0 0 0 {UNIT2}",
               f"EDGE_SE2 0.2 A0 A1 1 0 0.1 {UNIT2}", "EDGE_SE2_XY 0.2 A1 L7 2 4 1 0 1", "EDGE_RANGE 0.2 A1 L7 4.5 0.25"),
    "a.tum": ("# stamp", "1.5 0 0 0 0 0 0 1", "2.5 0 0 0 0 0 0.6 0.8"),
    "a.kitti": ("1 0 0 0 0 1 0 0 0 0 1 0", "0 -1 0 3 1 0 0 2 0 0 1 1"),
    "a.euroc": ("#timestamp,x,y,z,qw,qx,qy,qz", "15,0,0,0,1,0,0,0", "25,0,0,0,0.6,0,0,0.8"),
    "a.csv": ("stamp_ns,x,y,z,qx,qy,qz,qw", "15,0,0,0,0,0,0,1", "25,0,0,0,0,0,0.6,0.8"),
}  # fmt: skip
WORDS = ("", "nan", "-inf", "1e308", "-1e308", "1e-320", "1e999", "0", "-1", "-0.0", "18446744073709551615", "18446744073709551616",
         "9" * 5000, "1_0", "٣", "1,5", "0x1F", "#", "\x00", "\ufeff", "VERTEX_SE2", "EDGE_SE2", "A0", "L7", "\t", "\r", "é" * 60)  # fmt: skip


def read_anyhow(path):
    """Read as graph and as trajectory, by content and by each reader itself; True if anything could."""
    understood, complaints = False, []
    readers = [read_graph, read_trajectory, *(form.module.read for form in FORMATS)]
    for read in readers:
        try:
            found = read(path)
        except BadFile as error:
            complaints.append(str(error))
        else:
            understood = True
            if hasattr(found, "edges"):
                for record in measurements(found):
                    assert record.stamp > 0
    for complaint in complaints:
        assert complaint.startswith(str(path))
        assert "\n" not in complaint
        assert len(complaint) < len(str(path)) + 400
    return understood


@pytest.mark.parametrize("name", GOOD)
def test_the_files_that_are_mutated_below_are_good(file, name):
    assert read_anyhow(file(name, *GOOD[name]))


@pytest.mark.parametrize("name", GOOD)
def test_no_mutation_raises_anything_but_bad_file(tmp_path, name):
    """Words replaced, dropped, doubled and swapped; lines dropped, doubled and cut; seeded."""
    rng = random.Random(name)
    path = tmp_path / name
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(300):
            lines = [line.split(" ") for line in GOOD[name]]
            for _ in range(rng.choice((1, 1, 2, 5))):
                mutate(lines, rng)
            path.write_text("\n".join(" ".join(words) for words in lines), newline="")
            read_anyhow(path)


def mutate(lines, rng):
    line = rng.choice(lines)
    at = rng.randrange(len(line)) if line else 0
    kind = rng.choice(("replace", "replace", "replace", "drop", "double", "swap", "line", "cut"))
    if kind == "line":
        lines.insert(rng.randrange(len(lines)), list(rng.choice(lines)))
    elif not line:
        return
    elif kind == "replace":
        line[at] = rng.choice(WORDS)
    elif kind == "drop":
        del line[at]
    elif kind == "double":
        line.insert(at, line[at])
    elif kind == "swap":
        other = rng.randrange(len(line))
        line[at], line[other] = line[other], line[at]
    else:
        del line[at:]


@pytest.mark.parametrize("name", GOOD)
def test_a_file_cut_anywhere_is_read_or_refused(tmp_path, name):
    data = "\n".join(GOOD[name]).encode()
    for end in range(len(data)):
        (tmp_path / name).write_bytes(data[:end])
        read_anyhow(tmp_path / name)


@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.binary(max_size=200), name=st.sampled_from(sorted(GOOD)))
def test_random_bytes_are_refused(tmp_path, data, name):
    (tmp_path / name).write_bytes(data)
    read_anyhow(tmp_path / name)


@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    numbers=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=28, max_size=28),
    planar=st.booleans(),
)
def test_any_finite_numbers_are_read_without_a_warning_or_refused(tmp_path, numbers, planar):
    tag, count = ("EDGE_SE2", 9) if planar else ("EDGE_SE3:QUAT", 28)
    (tmp_path / "a.g2o").write_text(f"{tag} 0 1 {' '.join(map(repr, numbers[:count]))}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_anyhow(tmp_path / "a.g2o")


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (["VERTEX_SE2 0 0 0 0", "EDGE_SE2 0 7 1 0 0 " + UNIT2], "2: EDGE_SE2 0 7: 7 has no VERTEX line in this file"),
        (["VERTEX_SE2 0 0 0 0", "EDGE_SE2 8 0 1 0 0 " + UNIT2], "2: EDGE_SE2 8 0: 8 has no VERTEX line in this file"),
        (["VERTEX_SE2 0 0 0 0", "FIX 3"], "2: FIX 3: 3 has no VERTEX line in this file"),
        (["EDGE_SE2 0 1 1 0 0 1 2 0 1 0 1"], "1: EDGE_SE2 0 1: its information matrix is indefinite"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1"], "1: EDGE_SE2 0 1: its information matrix is indefinite"),
        (["EDGE_SE2 0 1 1 0 0 0 1 0 1 0 1"], "1: EDGE_SE2 0 1: its information matrix is indefinite"),
        (["EDGE_SE2 0 1 1 0 0 1e12 0 0 1e12 0 -1e-3"], "1: EDGE_SE2 0 1: its information matrix is indefinite"),
        (["EDGE_SE2 0 0 1 0 0 " + UNIT2], "1: EDGE_SE2 0 0: is an edge from a vertex to itself"),
        (["EDGE_SE2 0 1 1 0 0"], "1: EDGE_SE2 0 1: 6 words where 12 are needed: 1 tag + 2 id + 3 state + 6 noise"),
        (["EDGE_SE2 0 1 1 0 x " + UNIT2], "1: x: is not a number"),
        (["EDGE_SE2 0 1 1 0 nan " + UNIT2], "1: nan: is not a finite number"),
        (["EDGE_SE2 0 1 1 0 1e400 " + UNIT2], "1: 1e400: is not a finite number"),
        (["EDGE_SE2 0 -1 1 0 0 " + UNIT2], "1: -1: is not an id (an integer from 0 to 2^64 - 1)"),
        (["EDGE_SE2 0 1.0 1 0 0 " + UNIT2], "1: 1.0: is not an id (an integer from 0 to 2^64 - 1)"),
        (["VERTEX_SE2 0 0 0 0", "", "VERTEX_SE2 0 0 1 0"], "3: VERTEX_SE2 0: is stated a second time with other numbers (before: line 1)"),
        (["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0"], "1: 0 0 0 0: is no rotation: the quaternion's length is zero or absurd"),
        (["VERTEX_SE2 0 0 0 0", "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1"], "2: VERTEX_SE3:QUAT: a line of a 3-D graph in a file that also has lines of a planar one"),
        (["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "EDGE_SE3_TRACKXYZ 0 9 4 2 1 3 1 0 0 1 0 1"], "2: EDGE_SE3_TRACKXYZ 0 9 4: the sensor's offset 4 has no PARAMS_SE3OFFSET line"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_file_line_and_words(file, lines, complaint):
    path = file("a.g2o", *lines)
    with pytest.raises(BadFile) as error:
        read_graph(path)
    assert str(error.value) == f"{path}:{complaint}"


def test_the_first_of_many_bad_edges_is_named(file):
    good, bad = f"EDGE_SE2 0 1 1 0 0 {UNIT2}", "EDGE_SE2 0 1 1 0 0 1 2 0 1 0 1"
    with pytest.raises(BadFile, match=r"a\.g2o:1001: "):
        read_graph(file("a.g2o", *[good] * 1000, bad, bad))


def test_a_vertex_stated_twice_alike_is_one_vertex(file):
    assert len(read_graph(file("a.g2o", "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 0 0 0 0")).ids) == 1


def test_information_that_is_zero_or_scaled_like_metres_and_radians_is_no_error(file):
    graph = read_graph(
        file("a.g2o", "EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0", "EDGE_SE2 0 1 1 0 0 1e-9 0 0 1e-9 0 1e12")
    )
    assert len(graph.edges) == 2


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"\x00\x01\x02", "is a binary file, not text"),
        (b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 \xff 0 0\n", ":2: byte 0xff: is not text (UTF-8)"),
        (b"# nothing\n", "holds nothing but comments and white space"),
        (b"hello world\n", "no line of this file has a known tag"),
    ],
)
def test_a_file_that_is_no_graph_at_all_says_why(tmp_path, data, complaint):
    path = tmp_path / "a.g2o"
    path.write_bytes(data)
    with pytest.raises(BadFile) as error:
        read_graph(path)
    assert str(error.value).startswith(str(path))
    assert complaint in str(error.value)


def test_a_missing_file_and_a_directory_are_named(tmp_path):
    for path, complaint in ((tmp_path / "none.g2o", "No such file"), (tmp_path, "Is a directory")):
        for read in (read_graph, read_trajectory):
            with pytest.raises(BadFile, match=complaint):
                read(path)


def test_windows_line_ends_and_a_byte_order_mark_change_nothing(tmp_path):
    text = "\r\n".join(GOOD["planar.g2o"])
    (tmp_path / "a.g2o").write_bytes(b"\xef\xbb\xbf" + text.encode())
    graph = read_graph(tmp_path / "a.g2o")
    assert (len(graph.ids), len(graph.edges), np.diag(graph.edges.information[0]).tolist()) == (
        2,
        1,
        [1, 1, 1],
    )
