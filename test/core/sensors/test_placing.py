"""Where a landmark is that has been seen only by range or by bearing."""

import numpy as np
import pytest

from slam_backend.core.sensors.drift import Drift
from slam_backend.core.sensors.placing import Sighting, is_due, place
from slam_backend.core.space import SPACES


def seen(space, positions, target, rng, distance=0.0, direction=0.0) -> list[Sighting]:
    """From sensors that look along x; sigmas of what they measure, 0: not measured."""
    found = []
    for number, position in enumerate(positions):
        offset = target - position
        aim = offset / np.linalg.norm(offset) + direction * rng.standard_normal(len(target))
        found.append(
            Sighting(
                space.rigid(np.eye(len(target)), position),
                number,
                np.linalg.norm(offset) + distance * rng.standard_normal() if distance else None,
                distance,
                aim / np.linalg.norm(aim) if direction else None,
                direction,
            )
        )
    return found


def way(space, bend) -> np.ndarray:
    """20 m ahead; bent to one side, and in space upwards as well."""
    t = np.linspace(0, 1, 25)
    return np.stack([20 * t, bend * np.sin(np.pi * t), bend * np.sin(3 * np.pi * t)], axis=1)[
        :, : space.point_dimension
    ]


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return SPACES[request.param]


def test_ranges_from_a_bent_way_place_a_beacon_as_well_as_they_say(space):
    """Errors over the stated sigma: the largest axis of the covariance bounds the mean square error of the point."""
    rng, errors = np.random.default_rng(3), []
    target = np.array([8.0, 11.0, 4.0])[: space.point_dimension]
    for _ in range(60):
        found = place(seen(space, way(space, 6.0), target, rng, distance=0.1))
        assert found.point is not None
        errors.append(np.linalg.norm(found.point - target) / found.sigma)
    assert 0.5 < np.mean(np.square(errors)) < space.point_dimension


def test_ranges_from_a_straight_line_fit_two_places_and_both_are_kept():
    space, rng = SPACES["2d"], np.random.default_rng(4)
    found = place(seen(space, way(space, 0.0), np.array([8.0, 11.0]), rng, distance=0.1))
    assert found.point is None
    assert "two places fit" in found.why
    mirrored = sorted(each.tolist() for each in found.others)
    np.testing.assert_allclose(mirrored, [[8, -11], [8, 11]], atol=0.5)


def test_in_space_ranges_from_a_plane_do_not_tell_above_from_below():
    space, rng = SPACES["3d"], np.random.default_rng(5)
    flat = way(space, 6.0) * (1, 1, 0)
    found = place(seen(space, flat, np.array([8.0, 11.0, 4.0]), rng, distance=0.05))
    assert found.point is None
    assert sorted(round(each[2]) for each in found.others) == [-4, 4]


def test_bearings_place_a_landmark_once_there_is_parallax(space):
    rng = np.random.default_rng(6)
    target = np.array([30.0, 25.0, 4.0])[: space.point_dimension]
    sightings = seen(space, way(space, 2.0), target, rng, direction=0.01)
    early, late = place(sightings[:6]), place(sightings)
    assert early.point is None
    assert "parallax" in early.why
    assert late.point is not None
    assert np.linalg.norm(late.point - target) < 3 * late.sigma


def test_a_third_of_wild_ranges_does_not_move_the_place(space):
    rng = np.random.default_rng(7)
    target = np.array([8.0, 11.0, 4.0])[: space.point_dimension]
    sightings = seen(space, way(space, 6.0), target, rng, distance=0.1)
    wild = [s._replace(distance=s.distance + 15) if n % 3 == 0 else s for n, s in enumerate(sightings)]
    found = place(wild)
    assert found.point is not None
    assert np.linalg.norm(found.point - target) < 0.5


def test_sightings_that_contradict_each_other_place_nothing(space):
    rng = np.random.default_rng(8)
    target = np.array([8.0, 11.0, 4.0])[: space.point_dimension]
    sightings = seen(space, way(space, 6.0), target, rng, distance=0.1)
    noise = [s._replace(distance=float(rng.uniform(5, 25))) for s in sightings]
    assert place(noise).point is None


def test_a_robot_that_stands_still_learns_nothing_new():
    space, rng = SPACES["2d"], np.random.default_rng(9)
    target = np.array([8.0, 11.0])
    sightings = seen(space, way(space, 6.0), target, rng, distance=0.1)
    parked = [sightings[0]._replace(distance=sightings[0].distance + 1.0)] * 500  # alike, and alike wrong
    assert np.linalg.norm(place([*parked, *sightings]).point - target) < 0.5


def test_attempts_come_at_fixed_numbers_of_sightings_so_that_windows_do_not_matter():
    one_by_one = [n for n in range(1, 400) if is_due(n - 1, n, 2)]
    assert one_by_one[0] == 4
    assert len(one_by_one) < 25
    for first, last in ((0, 400), (3, 60), (100, 399)):
        assert is_due(first, last, 2) == any(first < n <= last for n in one_by_one)


def test_what_drift_alone_has_lifted_off_a_plane_does_not_tell_above_from_below():
    """The robot is believed to have left the plane, and has not. Without that doubt some believe a place, on either side of it."""
    space, rng = SPACES["3d"], np.random.default_rng(10)
    flat = way(space, 6.0) * (1, 1, 0)
    step, believed = space.diagonal(1e-8, 0.15**2), []
    for _ in range(6):
        rise = np.cumsum(rng.normal(0, 0.15, len(flat)))[:, None] * (0, 0, 1)
        sightings = seen(space, flat, np.array([8.0, 11.0, 6.0]), rng, distance=0.05)
        told = [
            each._replace(sensor=space.rigid(np.eye(3), position))
            for each, position in zip(sightings, flat + rise, strict=True)
        ]
        drift = Drift([each.sensor for each in told], [step] * (len(told) - 1))
        assert place(told, lambda _, drift=drift: drift).point is None
        believed.append(place(told).point)
    assert any(point is not None for point in believed)
