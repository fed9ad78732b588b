"""How a source does: numbers and words that a person looks for first."""

import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import GnssSource, config_from
from slam_backend.core.fixes import Fixes
from slam_backend.core.measurement import SECOND, ImuSample, frozen
from slam_backend.core.sensors.gnss import Fix

ZERO = frozen((0.0,) * 9)


def test_a_receiver_tells_its_fixes_and_whether_the_yaw_can_be_told(road):
    items, _ = road.drive("2d")
    found = road.backend("2d", sources={"gps": {"kind": "gnss", "withhold_every": 10}})
    for item in items[:6]:
        found.add(item)
    early = found.conditions()["gps"]
    assert (early["told"], early["in_graph"], early["status"]) == ("3", "0", "fix")
    assert early["yaw"].startswith("yaw not yet observable: the fixes reach over")
    assert "sigma_yaw_rad" not in early
    road.run(found, items[6:-4])
    later = found.conditions()
    assert (later["gps"]["told"], later["gps"]["withheld"], later["gps"]["in_graph"]) == ("118", "11", "107")
    assert later["gps"]["yaw"] == "observable"
    assert 0 < float(later["gps"]["sigma_yaw_rad"]) < 0.1
    assert later["gps"]["since_s"] == "0.00"
    for item in (item for item in items[-4:] if item.source == "wheels"):
        found.add(item)
    assert found.conditions()["gps"]["since_s"] == "2.00"
    assert int(later["wheels"]["in_graph"]) == 117


def test_the_status_is_that_of_the_newest_fix():
    """Whatever order they come in."""
    fixes, place = Fixes(), frozen((48.0, 11.0, 500.0))
    for stamp, status in ((2, 0), (5, 2), (3, 1)):
        fixes.add(
            Fix(stamp * SECOND, "gps", "", place, frozen([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), status),
            GnssSource(),
        )
    tally = fixes.tally("gps")
    assert (tally.told, tally.newest, tally.status) == (3, 5 * SECOND, 2)
    assert fixes.tally("another").told == 0


def test_an_imu_tells_its_bias_with_its_sigma():
    """At rest, where the gyroscope's mean is its bias."""
    config = {
        "space": "3d",
        "sources": ["imu"],
        "imu": {"kind": "imu", "topic": "/imu"},
        "keyframes": {"time": 0.5},
    }
    backend = Backend(config_from(config))
    for n in range(600):
        stamp = SECOND + n * SECOND // 100
        rate, acceleration = frozen((0.01, -0.02, 0.0)), frozen((0.0, 0.0, 9.80665))
        backend.add(ImuSample(stamp, "imu", "", rate, acceleration, ZERO, ZERO))
    told = backend.conditions()["imu"]
    gyroscope, sigma = (
        list(map(float, told[name].split())) for name in ("bias_gyroscope", "sigma_bias_gyroscope")
    )
    assert gyroscope == pytest.approx([0.01, -0.02, 0.0], abs=2e-3)
    assert all(0 < each < 0.1 for each in sigma)
    assert len(told["bias_accelerometer"].split()) == len(told["sigma_bias_accelerometer"].split()) == 3
