"""Solutions of RTKLIB and the log of an IMU beside them: what is read, and whose clock is laid onto whose."""

import numpy as np
import pymap3d
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.gnss import DECODERS as FIXES
from slam_backend.core.sensors.imu import DECODERS as SAMPLES
from slam_backend.io.bags import open_bag
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.rtklib import solution

HEAD = "%  GPST            latitude(deg) longitude(deg) height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)"
APART = 41.7  # s that the IMU's clock is behind


@pytest.fixture
def folder(tmp_path):
    """A minute on a winding road, 4 fixes and 50 samples a second."""
    seconds = np.arange(0, 60, 0.01)
    course = 0.8 * np.sin(seconds / 4) + 0.7 * np.sin(seconds**1.6 / 7)
    track = 8 * np.cumsum(np.stack([np.cos(course), np.sin(course)], axis=1), axis=0) * 0.01
    lines = ["% program : by hand", HEAD]
    for k in range(0, len(seconds), 25):
        place = pymap3d.enu2geodetic(*track[k], 0.0, 40.0, -105.0, 1600.0)
        clock = f"2025/07/08 19:34:{seconds[k]:06.3f}"
        lines.append(
            f"{clock} {place[0]:.9f} {place[1]:.9f} {place[2]:.4f} {1 + (k == 0)} 9 0.02 0.03 0.05 -0.01 0 0.004 0 0"
        )
    (tmp_path / "drive.pos").write_text("\n".join([*lines, ""]))
    turning = np.degrees(np.gradient(course, seconds))
    rows = [
        f"0.1,0.0,1.0,0.0,0.0,{turning[k]:.4f},{round((seconds[k] + APART) * 1e3)}"
        for k in range(200, len(seconds), 2)
    ]
    (tmp_path / "imu_1.csv").write_text("\n".join([*rows, rows[-1], ""]))
    return tmp_path


def test_a_solution_is_read_with_its_covariance_and_quality(folder):
    """Standard deviations of two axes are signed roots of their covariance."""
    stamps, places, covariances, quality = solution(folder / "drive.pos")
    assert stamps[1] - stamps[0] == SECOND // 4
    assert stamps[0] == 1752003240 * SECOND
    np.testing.assert_allclose(places[0], [40.0, -105.0, 1600.0], atol=1e-4)
    expected = [[9e-4, -1e-4, 0.0], [-1e-4, 4e-4, 1.6e-5], [0.0, 1.6e-5, 25e-4]]
    np.testing.assert_allclose(covariances[3], expected, atol=1e-12)
    assert quality[:2].tolist() == [2, 1]


def test_a_week_and_its_seconds_are_the_same_moment(folder):
    path = folder / "drive.pos"
    path.write_text(path.read_text().replace("2025/07/08 19:34:00.000", "2374 243240.000"))
    stamps, *_ = solution(path)
    assert stamps[0] == 1752003240 * SECOND


def test_the_clock_of_the_imu_is_laid_onto_the_receivers_by_the_turns(folder):
    made = make_dataset("rtklib", folder / "out.mcap", folder=folder)
    with open_bag(made.path) as bag:
        records = {topic: list(bag.records({topic})) for topic in ("/fix", "/imu")}

        def first(topic, decoders):
            record = records[topic][0]
            return decoders[record.type](bag.typestore.deserialize_cdr(record.data, record.type), "it")

        fix, sample = first("/fix", FIXES), first("/imu", SAMPLES)
    assert [len(records["/fix"]), len(records["/imu"])] == [240, 2900]
    assert abs((sample.stamp - fix.stamp) / SECOND - 2.0) < 0.15
    np.testing.assert_allclose(sample.acceleration, [0.980665, 0.0, 9.80665], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [("", "no line names its columns"), (HEAD + "\n", "no solution"), (HEAD + "\n1 2 3\n", "drive.pos:2")],
)
def test_what_is_no_solution_is_named(folder, text, words):
    (folder / "drive.pos").write_text(text)
    with pytest.raises(BadFile, match=words):
        solution(folder / "drive.pos")
