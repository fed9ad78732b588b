"""A whole back-end on the earth: the yaw that nobody knew is found, what holds the map changes hands, and all of it survives."""

import numpy as np
import pymap3d
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.graph import DATUM, EARTH
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.space import SPACES

ORIGIN = (42.3758, -71.1474, 12.0)
ARM = (0.8, -0.3, 1.2)
YAW = 2.0  # rad, of the earth in the map
SIGMA = 0.3  # m, of a fix


def drive(space, seed=0, seconds=120):
    """Odometry along a winding road, once a second, and a fix with noise after each: (measurements, true poses on the earth)."""
    rng, space = np.random.default_rng(seed), SPACES[space]
    pose, odometry = space.identity, space.identity
    start = space.from_extrinsics((40.0, -25.0, 3.0, 0.0, 0.0, -YAW))  # earth_T_map
    items, truth = [], []
    arm = np.array(ARM[: space.point_dimension])
    for k in range(seconds):
        stamp = (k + 1) * SECOND
        seven = frozen(space.seven(odometry))
        items.append(OdometryPose(stamp, "wheels", "odom", "base", seven, UNKNOWN, STILL, UNKNOWN))
        truth.append(start.compose(pose))
        antenna = np.append(truth[-1].transformFrom(arm), np.zeros(3 - len(arm)))
        place = pymap3d.enu2geodetic(*(antenna + rng.normal(0, SIGMA, 3)), *ORIGIN)
        items.append(Fix(stamp, "gps", "antenna", frozen(place), frozen(np.eye(3) * SIGMA**2)))
        step = space.from_extrinsics((1.0, 0.0, 0.05 * np.sin(k / 9), 0.0, 0.0, 0.1 * np.sin(k / 10)))
        pose = pose.compose(step)
        noise = rng.normal(0, 1, space.dimension) * np.sqrt(np.diag(space.diagonal(0.01**2, 0.03**2)))
        odometry = odometry.compose(step).compose(space.expmap(noise))
    return items, truth


def backend(space, **more):
    sources = {"wheels": {"kind": "odometry"}, "gps": {"kind": "gnss"}, **more.pop("sources", {})}
    wheels = {"sigma_translation_per_meter": 0.03, "sigma_rotation_per_meter": 0.01}
    data = {"space": space, "sources": list(sources), **sources, "extrinsics": {"antenna": [*ARM, 0, 0, 0]}}
    return Backend(config_from({**data, "wheels": {**sources["wheels"], **wheels}, **more}))


def errors(found, truth) -> np.ndarray:
    """(N,) m between where the keyframes are believed to be on the earth, and where they are."""
    earth = found.estimate.pose(EARTH)
    return np.array(
        [
            np.linalg.norm(earth.between(found.estimate.pose(k.pose)).translation() - true.translation())
            for k, true in zip(found.timeline.keyframes, truth, strict=True)
        ]
    )


def run(found, items):
    decisions = [d for item in items for update in found.add(item) for d in update.decisions]
    decisions += [d for update in found.finish() for d in update.decisions]
    found.polish()
    return decisions


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return request.param


def test_the_yaw_is_found_and_the_path_lies_on_the_earth(space):
    items, truth = drive(space)
    found = backend(space, earth={"origin": ORIGIN})
    run(found, items)
    assert DATUM in found.solver.factors
    assert not [f for f in found.solver.factors.values() if f.kind == "gauge"]
    away = errors(found, truth)
    assert np.sqrt(np.mean(away**2)) < 0.25  # m; a single fix is 0.4 to 0.5 m off
    map_T_base = found.estimate.pose(found.timeline.keyframes[0].pose)
    assert found.space.size(map_T_base)[1] < 0.1  # the map still begins at the robot


def test_before_the_path_is_long_enough_fixes_wait_and_nothing_moves(space):
    items, _ = drive(space, seconds=4)
    found = backend(space, earth={"origin": ORIGIN})
    decisions = run(found, items)
    assert not found.estimate.knows(EARTH)
    assert {(d.verdict, d.reason) for d in decisions} == {
        ("probation", "undetermined"),
        ("refused", "undetermined"),
    }
    assert all("yaw not yet observable" in d.detail for d in decisions)


def test_beside_absolute_poses_the_earth_is_free_and_the_map_stays_theirs(space):
    """A localizer says where the robot is in the map, the fixes where it is on the earth: both hold."""
    items, truth = drive(space)
    shape = SPACES[space]
    into_map = shape.from_extrinsics((7.0, 1.0, 0.0, 0.0, 0.0, 0.5)).compose(truth[0].inverse())
    for k in range(0, 120, 10):
        pose = frozen(shape.seven(into_map.compose(truth[k])))
        known = AbsolutePose((k + 1) * SECOND, "amcl", "", pose, frozen(np.eye(6).reshape(36) * 0.05**2))
        items.append(known)
    items.sort(key=lambda item: item.stamp)
    found = backend(space, earth={"origin": ORIGIN}, sources={"amcl": {"kind": "pose"}})
    run(found, items)
    assert DATUM not in found.solver.factors
    assert np.sqrt(np.mean(errors(found, truth) ** 2)) < 0.35
    last = found.estimate.pose(found.timeline.keyframes[-1].pose)
    assert shape.size(into_map.compose(truth[-1]).between(last))[0] < 0.5
    assert shape.size(into_map.between(found.estimate.pose(EARTH)))[1] < 0.05


def test_the_first_fix_is_the_origin_unless_one_is_given(space):
    items, _ = drive(space, seconds=3)
    found = backend(space)
    run(found, items)
    assert found.origin == tuple(items[1].place)


def test_a_run_with_fixes_ends_in_the_same_bits_again(space):
    ends = []
    for _ in range(2):
        found = backend(space)
        run(found, drive(space)[0])
        ends.append(found.snapshot().trajectory.sevens)
    np.testing.assert_array_equal(*ends)


def test_fixes_that_are_kept_back_take_no_part_and_are_compared(space):
    items, _ = drive(space)
    found = backend(space, sources={"gps": {"kind": "gnss", "withhold": [[50, 70]], "withhold_every": 7}})
    decisions = run(found, items)
    compared = found.compared(found.snapshot())
    seconds = compared.stamps // SECOND - 1
    expected = ((seconds >= 50) & (seconds < 70)) | ((seconds + 1) % 7 == 0)
    np.testing.assert_array_equal(compared.withheld, expected)
    assert sum(d.reason == "withheld" for d in decisions) == expected.sum()
    assert sum(f.kind == "gnss" for f in found.solver.factors.values()) == 120 - expected.sum()
    away = np.linalg.norm((compared.antennas - compared.fixes)[:, :2], axis=1)
    assert np.median(away[compared.withheld]) < 1.5


def test_before_the_map_has_a_place_on_the_earth_nothing_is_compared_with_the_fixes(space):
    found = backend(space)
    run(found, drive(space, seconds=4)[0])
    assert found.earth() is None
    assert np.isnan(found.compared(found.snapshot()).antennas).all()
    assert backend(space).compared(None) is None
