"""Numbers of one message: stamps, poses, sightings."""

from math import isfinite

import numpy as np

from ..measurement import SECOND, Array, ImuSample
from ..sensors.gnss import Fix
from ..sensors.landmark import FORMS, LandmarkObservation, used_axes
from ..space import Space
from .rules import FARTHEST, LATEST, QUATERNION_TOLERANCE, VIOLENT, Fault


def judge_stamps(*stamps: int) -> None:
    for stamp in stamps:
        if stamp <= 0:
            raise Fault("zero_stamp", float(stamp))
        if stamp >= LATEST * SECOND:
            raise Fault("far_stamp", float(stamp // SECOND))


def judge_pose(seven: Array, space: Space) -> None:
    x, y, z, qx, qy, qz, qw = seven.tolist()
    if space.name == "2d":
        z = 0.0
    square = qx * qx + qy * qy + qz * qz + qw * qw
    total = x + y + z + square
    if not isfinite(total) or max(abs(x), abs(y), abs(z)) > FARTHEST:
        raise Fault("not_finite")
    if abs(square - 1) > QUATERNION_TOLERANCE:
        raise Fault("quaternion", square)


def judge_sample(item: ImuSample) -> None:
    """Rates and accelerations that a robot can have."""
    numbers = (*item.rate.tolist(), *item.acceleration.tolist())
    if not max(map(abs, numbers)) < VIOLENT or not isfinite(sum(numbers)):
        raise Fault("not_finite")


def judge_sighting(item: LandmarkObservation, space: Space) -> tuple[int, ...]:
    """The axes of its value that the space uses."""
    if not item.landmark:
        raise Fault("landmark_id")
    if item.form not in FORMS:
        raise Fault("landmark_kind")
    keep = used_axes(item.form, len(item.covariance), space)
    if item.form == "pose":
        judge_pose(item.value, space)
    elif not all(isfinite(v) and abs(v) < FARTHEST for v in item.value[list(keep)].tolist()):
        raise Fault("not_finite")
    if item.form in ("bearing_range", "range") and item.value[-1] <= 0:
        raise Fault("range", float(item.value[-1]))
    if item.form in ("pose", "position") and not np.any(item.value[: space.point_dimension]):
        raise Fault("range", 0.0)
    return keep


def judge_fix(item: Fix, space: Space) -> tuple[int, ...]:
    """The axes of east, north, up that the space uses."""
    if item.status < 0:
        raise Fault("no_fix", float(item.status))
    latitude, longitude, altitude = item.place.tolist()
    if space.name == "2d":
        altitude = 0.0
    if not isfinite(latitude + longitude + altitude) or abs(altitude) > FARTHEST:
        raise Fault("not_finite")
    if abs(latitude) > 90 or abs(longitude) > 180 or latitude == longitude == 0:
        raise Fault("off_earth", latitude)
    return tuple(range(space.point_dimension))
