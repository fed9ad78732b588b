"""Trajectory files: TUM, KITTI, EuRoC and our csv."""

import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.core.geometry import matrix_of
from slam_backend.io.formats import read_trajectory, tum, write_trajectory
from slam_backend.io.formats.trajectory import Trajectory


def random_trajectory(n=200):
    rng = np.random.default_rng(7)
    stamps = np.cumsum(rng.integers(1, 10**9, n)) + 1_700_000_000_000_000_001
    sevens = np.column_stack([rng.normal(0, 100, (n, 3)), rng.normal(size=(n, 4))])
    return Trajectory(stamps, sevens)


@pytest.mark.parametrize("name", ["a.tum", "a.txt", "a.csv", "a.euroc", "a.euroc.csv"])
def test_stamps_and_numbers_survive_to_the_bit(tmp_path, name):
    trajectory = random_trajectory()
    assert write_trajectory(tmp_path / name, trajectory) == ()
    again = read_trajectory(tmp_path / name)
    assert again.stamps.dtype == np.int64
    assert np.array_equal(again.stamps, trajectory.stamps)
    assert again.sevens.tobytes() == trajectory.sevens.tobytes()


def test_kitti_keeps_the_poses_and_says_that_it_has_no_stamps(tmp_path):
    trajectory = random_trajectory()
    assert write_trajectory(tmp_path / "a.kitti", trajectory) == ("stamps",)
    again = read_trajectory(tmp_path / "a.kitti")
    np.testing.assert_allclose(matrix_of(again.sevens), matrix_of(trajectory.sevens), atol=1e-12)
    assert again.stamps[:3].tolist() == [0, 100_000_000, 200_000_000]
    assert "no stamps" in again.notes[0]


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1311868164.363181", 1311868164363181000),
        ("1305031102.1758", 1305031102175800000),
        ("1.311868164363181000e+09", 1311868164363181000),
        ("0", 0),
        ("12.", 12_000_000_000),
        (".5", 500_000_000),
        ("-0.25", -250_000_000),
        ("3856.85734605789", 3856857346058),
        ("1700000000.123456789", 1700000000123456789),
    ],
)
def test_seconds_are_read_as_decimal_text(file, text, stamp):
    """As a float 1700000000.123456789 would lose its last two digits."""
    assert tum.read(file("a.tum", f"{text} 0 0 0 0 0 0 1")).stamps.tolist() == [stamp]


@pytest.mark.parametrize(
    "text", ["nan", "inf", "1e30", "1e999999999", "1_0", "٣", "now", "0x10", "1e", "9300000000"]
)
def test_what_is_no_time_is_refused(file, text):
    with pytest.raises(BadFile, match=r"a\.tum:1: .*: is not a time in seconds"):
        tum.read(file("a.tum", f"{text} 0 0 0 0 0 0 1"))


def test_real_files_are_told_apart_by_their_content(shared):
    lengths = {
        "fr2_desk_ORB.txt": 2893,
        "fr2_desk_groundtruth.txt": 20957,
        "KITTI_00_gt.txt": 4541,
        "KITTI_00_ORB.txt": 4541,
    }
    for name, length in lengths.items():
        assert len(read_trajectory(shared / "trajectories/evo" / name).stamps) == length


def test_euroc_columns_have_w_first_and_further_ones_are_skipped(file):
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v"
    )
    trajectory = read_trajectory(file("a.csv", header, "1403636580838555648,4,-1,0.7,0.5,0.1,-0.8,-0.1,9"))
    assert trajectory.stamps.tolist() == [1403636580838555648]
    assert trajectory.sevens.tolist() == [[4, -1, 0.7, 0.1, -0.8, -0.1, 0.5]]
    assert trajectory.notes == ("1 further columns skipped",)


def test_the_vertices_of_a_graph_file_count_as_a_trajectory(shared):
    trajectory = read_trajectory(shared / "pyfg_cora/plaza1.pyfg")
    assert trajectory.stamps[0] == 3856857346058
    assert read_trajectory(shared / "pgo_sesync/intel.g2o").stamps[0] == 100_000_000
    with pytest.raises(BadFile, match="states no vertices"):
        read_trajectory(shared / "pgo_sesync/CSAIL.g2o")


@pytest.mark.parametrize(
    ("name", "line", "complaint"),
    [
        ("a.tum", "0 1 2 3 0 0 0", "7 words where 8 are needed"),
        ("a.tum", "0 1 2 3 0 0 0 0", "is no rotation"),
        ("a.tum", "0 1 nan 3 0 0 0 1", "nan: is not a finite number"),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 2 0", "not orthonormal"),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 -1 0", "not orthonormal"),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 1", "11 words where 12"),
        ("a.euroc", "1.5,0,0,0,1,0,0,0", "not a time in whole nanoseconds"),
        ("a.csv", "1,0,0,0,1,0,0,0", None),
    ],
)
def test_what_is_wrong_is_named_with_its_line(file, name, line, complaint):
    first = {"a.tum": "0 1 2 3 0 0 0 1", "a.kitti": "1 0 0 0 0 1 0 0 0 0 1 0", "a.euroc": "1,0,0,0,1,0,0,0",
             "a.csv": "stamp_ns,x,y,z,qx,qy,qz,qw"}[name]  # fmt: skip
    path = file(name, first, line)
    if complaint is None:
        assert len(read_trajectory(path).stamps) == 1
        return
    with pytest.raises(BadFile, match=rf"{name}:2: .*{complaint}"):
        read_trajectory(path)


def test_what_is_not_finite_is_not_written(tmp_path):
    trajectory = random_trajectory(3)
    trajectory.sevens[1, 2] = np.nan
    with pytest.raises(BadFile, match="pose 1 is not finite"):
        write_trajectory(tmp_path / "a.tum", trajectory)
    assert not (tmp_path / "a.tum").exists()
