"""Calibrations: what a CameraInfo says, and pixels that are free of distortion as if the lens had none."""

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from slam_backend.core.config import Camera, PixelsSource
from slam_backend.core.errors import BadMessage
from slam_backend.core.sensors.camera import CameraModel, configured, decode_info, lens_of, undistorted
from slam_backend.core.sensors.triangulation import Lens
from slam_backend.io.encode import encode_camera_info

LENS = Lens(400.0, 410.0, 320.0, 240.0)
WIDE = (-0.28, 0.07, 1e-3, -5e-4)


def model_of(distortion) -> CameraModel:
    return CameraModel(
        0, "eye", LENS, np.pad(np.array(distortion, dtype=float), (0, 8 - len(distortion))), LENS
    )


def test_freed_from_distortion_a_pixel_is_where_gtsams_calibration_says():
    raw = np.random.default_rng(0).uniform([60, 40], [580, 440], (50, 2))
    found, _ = undistorted(raw, model_of(WIDE))
    bent = gtsam.Cal3DS2(*LENS[:2], 0.0, *LENS[2:4], *WIDE)
    straight = gtsam.Cal3_S2(*LENS[:2], 0.0, *LENS[2:4])
    expected = np.array([straight.uncalibrate(bent.calibrate(pixel)) for pixel in raw])
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_the_noise_is_stretched_as_areas_are():
    raw = np.array([[320.0, 240.0], [100.0, 80.0]])
    _, stretch = undistorted(raw, model_of(WIDE))
    for pixel, each in zip(raw, stretch, strict=True):
        corners = undistorted(pixel + np.array([[0, 0], [1e-3, 0], [0, 1e-3]]), model_of(WIDE))[0]
        sides = (corners[1:] - corners[0]) / 1e-3
        assert each**2 == pytest.approx(abs(np.linalg.det(sides)), rel=1e-2)


def test_where_the_model_does_not_hold_there_is_no_pixel():
    found, _ = undistorted(np.array([[4000.0, 3000.0]]), model_of((-0.4,)))
    assert np.isnan(found).all()


def test_the_info_of_a_right_camera_has_the_baseline():
    store = get_typestore(Stores.ROS2_JAZZY)
    data = encode_camera_info(7, "right", LENS[:4], 0.25, WIDE)
    told = decode_info(store.deserialize_cdr(data, "sensor_msgs/msg/CameraInfo"), "eye")
    assert told.rectified == LENS._replace(baseline=0.25)
    assert told.raw == LENS
    np.testing.assert_array_equal(told.distortion[:4], WIDE)


def test_a_camera_without_calibration_or_of_an_unknown_kind_is_refused():
    empty = SimpleNamespace(k=np.zeros(9), p=np.zeros(12), d=[], distortion_model="plumb_bob")
    stamp = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="eye")
    with pytest.raises(BadMessage, match="not calibrated"):
        decode_info(SimpleNamespace(**vars(empty), header=stamp), "eye")
    fish = SimpleNamespace(k=np.eye(3), p=np.zeros(12), d=[0.1], distortion_model="equidistant", header=stamp)
    with pytest.raises(BadMessage, match="equidistant"):
        decode_info(fish, "eye")


def test_the_configuration_stands_above_the_topic():
    told = model_of(())
    given = Camera(fx=1.0, fy=2.0, cx=3.0, cy=4.0)
    found = configured(PixelsSource(camera=given), told)
    assert lens_of(found, PixelsSource()) == Lens(1.0, 2.0, 3.0, 4.0)
    based = configured(PixelsSource(camera=Camera(baseline=0.5)), told)
    assert lens_of(based, PixelsSource()).baseline == 0.5
    assert configured(PixelsSource(), None) is None
