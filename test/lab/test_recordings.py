"""Data sets from a folder: what the files say is in the bag, in the frames and units of ROS."""

from pathlib import Path

import numpy as np
import pytest

from slam_backend.core.errors import BadConfig, BadFile
from slam_backend.core.sensors import landmark, odometry
from slam_backend.io.bags import open_bag
from slam_backend.io.formats import tum
from slam_backend.lab import mrclam
from slam_backend.lab.datasets import make_dataset
from test.lab.test_matlab import write_mat


def decoded(path: Path, topic: str, decode) -> list:
    with open_bag(path) as bag:
        return [decode(bag.typestore.deserialize_cdr(r.data, r.type), "x") for r in bag.records({topic})]


@pytest.fixture
def robots(tmp_path: Path) -> Path:
    """A robot that drives a quarter circle of 1 m radius in two rows, sees landmark 6, robot 2 and a misread barcode."""
    (tmp_path / "Barcodes.dat").write_text("# Subject # Barcode #\n  2 \t 14\n  6 \t 63\n")
    (tmp_path / "Landmark_Groundtruth.dat").write_text("# Subject x y sx sy\n6 0.5 -4.25 0.1 0.1\n")
    quarter = f"{np.pi / 4:.12f}"
    (tmp_path / "Robot1_Odometry.dat").write_text(
        f"# t v w\n10.5 {quarter} {quarter}\n11.5 {quarter} {quarter}\n12.5 0 0\n"
    )
    (tmp_path / "Robot1_Measurement.dat").write_text(
        "# t subject range bearing\n11.25 63 2.0 -0.5\n11.25 14 3.0 0.5\n11.25 99 1.0 0\n"
    )
    (tmp_path / "Robot1_Groundtruth.dat").write_text("# t x y yaw\n10.123456789 1 2 0.5\n")
    return tmp_path


def test_a_robot_of_mrclam_becomes_odometry_landmarks_other_robots_and_truth(robots: Path) -> None:
    """Rates are held along arcs; barcodes become subjects, those unknown are left out; stamps keep every digit."""
    made = make_dataset("mrclam1", robots / "out.mcap", folder=robots)
    poses = decoded(made.path, "/odom", odometry.decode_odometry)
    assert [p.stamp for p in poses] == [10_500_000_000, 11_500_000_000, 12_500_000_000]
    np.testing.assert_allclose(poses[-1].pose[:2], [1, 1], atol=1e-9)
    ((seen,),) = (list(cloud) for cloud in decoded(made.path, "/landmarks", landmark.decode_points))
    assert (seen.landmark, seen.form, seen.value.tolist()) == ("6", "bearing_range", [-0.5, 0, 2])
    ((other,),) = (list(cloud) for cloud in decoded(made.path, "/robots", landmark.decode_points))
    assert (other.landmark, other.stamp) == ("2", 11_250_000_000)
    assert made.truth is not None
    assert tum.read(made.truth).stamps.tolist() == [10_123_456_789]
    np.testing.assert_array_equal(mrclam.landmarks(robots)["6"], [0.5, -4.25])


def test_victoria_park_as_recorded_has_its_lever_arm_and_its_bearings(tmp_path: Path) -> None:
    """Straight on, the encoder's wheel is as fast as the middle; a trunk ahead is at azimuth 0; zeros are no trunks."""
    column = np.array([[0.0], [0.0], [0.0]])
    write_mat(
        tmp_path / "aa3_dr.mat", time=np.array([[21940], [22940], [23940]], dtype=np.int32),
        speed=column + 2, steering=column,
    )  # fmt: skip
    write_mat(
        tmp_path / "aa3_gpsx.mat", timeGps=np.array([[21940]], dtype=np.int32),
        Lo_m=np.array([[3.0]]), La_m=np.array([[4.0]]),
    )  # fmt: skip
    tables = {
        "lidar_ranges": np.array([[5.0, 0.0], [0.0, 0.0]]),
        "lidar_bearings": np.array([[np.pi / 2, 0.0], [0.0, 0.0]]),
        "lidar_signatures": np.array([[0.3, 0.0], [0.0, 0.0]]),
    }
    write_mat(tmp_path / "lidar_measurements.mat", compress=True, **tables)
    made = make_dataset("victoria_park_raw", tmp_path / "out.mcap", folder=tmp_path)
    np.testing.assert_allclose(decoded(made.path, "/odom", odometry.decode_odometry)[-1].pose[:2], [4, 0])
    ((seen,),) = (list(cloud) for cloud in decoded(made.path, "/trees", landmark.decode_points))
    assert (seen.frame, seen.stamp, seen.value.tolist()) == ("laser", 21_940_000_000, [0, 0, 5])
    assert made.truth is not None
    np.testing.assert_array_equal(tum.read(made.truth).sevens[0, :2], [3, 4])


def test_a_folder_that_is_missing_or_of_no_use_is_said(robots: Path) -> None:
    """Without a folder, with one that is not wanted, with a file that is not there, and with one that is no table."""
    out = robots / "out.mcap"
    with pytest.raises(BadConfig, match="--from"):
        make_dataset("mrclam1", out)
    with pytest.raises(BadConfig, match="comes with gtsam"):
        make_dataset("plaza1", out, folder=robots)
    with pytest.raises(BadFile, match=r"Robot2_Odometry\.dat"):
        make_dataset("mrclam2", out, folder=robots)
    (robots / "Robot1_Odometry.dat").write_text("1 2 x\n")
    with pytest.raises(BadFile, match="is not a table of 3 numbers"):
        make_dataset("mrclam1", out, folder=robots)
