"""A whole back-end on the earth: the yaw that nobody knew is found, what holds the map changes hands, and all of it survives."""

from dataclasses import replace

import numpy as np
import pymap3d
import pytest

from slam_backend.core.graph import DATUM, EARTH
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Trajectory

LATER = 1000 * SECOND  # between two drives
FAR = (400.0, -300.0, 0.0)  # m east, north, up: from the first drive to the second
NOTHING = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return request.param


def test_the_yaw_is_found_and_the_path_lies_on_the_earth(road, space):
    items, truth = road.drive(space)
    found = road.backend(space, earth={"origin": road.origin})
    road.run(found, items)
    assert DATUM in found.solver.factors
    assert not [f for f in found.solver.factors.values() if f.kind == "gauge"]
    away = road.errors(found, truth)
    assert np.sqrt(np.mean(away**2)) < 0.25  # m; a single fix is 0.4 to 0.5 m off
    map_T_base = found.estimate.pose(found.timeline.keyframes[0].pose)
    assert found.space.size(map_T_base)[1] < 0.1  # the map still begins at the robot


def test_before_the_path_is_long_enough_fixes_wait_and_nothing_moves(road, space):
    items, _ = road.drive(space, seconds=4)
    found = road.backend(space, earth={"origin": road.origin})
    decisions = road.run(found, items)
    assert not found.estimate.knows(EARTH)
    assert {(d.verdict, d.reason) for d in decisions} == {
        ("probation", "undetermined"),
        ("refused", "undetermined"),
    }
    assert all("yaw not yet observable" in d.detail for d in decisions)


def test_beside_absolute_poses_the_earth_is_free_and_the_map_stays_theirs(road, space):
    """A localizer says where the robot is in the map, the fixes where it is on the earth: both hold."""
    items, truth = road.drive(space)
    shape = SPACES[space]
    into_map = shape.from_extrinsics((7.0, 1.0, 0.0, 0.0, 0.0, 0.5)).compose(truth[0].inverse())
    for k in range(0, 120, 10):
        pose = frozen(shape.seven(into_map.compose(truth[k])))
        known = AbsolutePose((k + 1) * SECOND, "amcl", "", pose, frozen(np.eye(6).reshape(36) * 0.05**2))
        items.append(known)
    items.sort(key=lambda item: item.stamp)
    found = road.backend(space, earth={"origin": road.origin}, sources={"amcl": {"kind": "pose"}})
    road.run(found, items)
    assert DATUM not in found.solver.factors
    assert np.sqrt(np.mean(road.errors(found, truth) ** 2)) < 0.35
    last = found.estimate.pose(found.timeline.keyframes[-1].pose)
    assert shape.size(into_map.compose(truth[-1]).between(last))[0] < 0.5
    assert shape.size(into_map.between(found.estimate.pose(EARTH)))[1] < 0.05


def test_the_first_fix_is_the_origin_unless_one_is_given(road, space):
    items, _ = road.drive(space, seconds=3)
    found = road.backend(space)
    road.run(found, items)
    assert found.origin == tuple(items[1].place)


def test_a_run_with_fixes_ends_in_the_same_bits_again(road, space):
    ends = []
    for _ in range(2):
        found = road.backend(space)
        road.run(found, road.drive(space)[0])
        ends.append(found.snapshot().trajectory.sevens)
    np.testing.assert_array_equal(*ends)


def test_fixes_that_are_kept_back_take_no_part_and_are_compared(road, space):
    items, _ = road.drive(space)
    found = road.backend(
        space, sources={"gps": {"kind": "gnss", "withhold": [[50, 70]], "withhold_every": 7}}
    )
    decisions = road.run(found, items)
    compared = found.compared(found.snapshot())
    seconds = compared.stamps // SECOND - 1
    expected = ((seconds >= 50) & (seconds < 70)) | ((seconds + 1) % 7 == 0)
    np.testing.assert_array_equal(compared.withheld, expected)
    assert sum(d.reason == "withheld" for d in decisions) == expected.sum()
    assert sum(f.kind == "gnss" for f in found.solver.factors.values()) == 120 - expected.sum()
    away = np.linalg.norm((compared.antennas - compared.fixes)[:, :2], axis=1)
    assert np.median(away[compared.withheld]) < 1.5


def test_before_the_map_has_a_place_on_the_earth_nothing_is_compared_with_the_fixes(road, space):
    found = road.backend(space)
    road.run(found, road.drive(space, seconds=4)[0])
    assert found.earth() is None
    assert np.isnan(found.compared(found.snapshot()).antennas).all()
    assert road.backend(space).compared(None) is None


def test_a_session_goes_on_on_the_same_earth_once_it_has_found_the_map(road, space):
    """Its fixes wait until a loop has joined it to the map; then they hold it where the first session's held that."""
    items, truth = road.drive(space)
    first = road.backend(space, earth={"origin": road.origin})
    road.run(first, items[:120])
    second = road.backend(space, sources={"loops": {"kind": "relative"}}, robust=[])
    second.load(first.saved(first.snapshot().trajectory))
    assert second.origin == road.origin
    shape = SPACES[space]
    there = frozen(shape.seven(truth[10].between(truth[80])))
    stamps = (11 * SECOND, 81 * SECOND)
    loop = RelativePose(
        81 * SECOND, "loops", *stamps, "base", "base", there, frozen(np.eye(6).reshape(36) * 1e-4)
    )
    later = [item for item in items[120:] if item.stamp > 60 * SECOND]
    road.run(second, sorted([*later, loop], key=lambda item: item.stamp))
    assert len(second.parts) == 1
    assert sum(f.kind == "gnss" for f in second.solver.factors.values()) > 100
    assert np.sqrt(np.mean(road.errors(second, truth) ** 2)) < 0.3


def another(road, space, **length):
    """A second drive, another day and somewhere else, whose odometry begins at its own origin: (measurements, true poses)."""
    items, truth = road.drive(space, seed=1, **length)
    there = SPACES[space].from_extrinsics((*FAR, 0.0, 0.0, 0.0))
    return [_elsewhere(item, road.origin) for item in items], [there.compose(pose) for pose in truth]


def _elsewhere(item, origin):
    item = replace(item, stamp=item.stamp + LATER)
    if not isinstance(item, Fix):
        return item
    place = np.array(pymap3d.geodetic2enu(*item.place, *origin)) + FAR
    return replace(item, place=frozen(pymap3d.enu2geodetic(*place, *origin)))


def test_a_second_drive_is_joined_to_the_map_by_its_fixes_far_from_where_the_first_began(road, space):
    """No loop, no landmark in common: the earth is what both know."""
    items, truth = road.drive(space)
    first = road.backend(space, earth={"origin": road.origin})
    road.run(first, items)
    second = road.backend(space)  # the map has an origin
    second.load(first.saved(NOTHING))
    later, true = another(road, space)
    decisions = road.run(second, later)
    assert len(second.parts) == 1
    assert [d.verdict for d in decisions if (d.stage, d.reason) == ("gnss", "joined")] == ["accepted"]
    used = [sum(f.kind == "gnss" for f in each.solver.factors.values()) for each in (first, second)]
    assert used[1] == used[0] + 120, "none is lost"
    assert [id_ for id_, factor in second.solver.factors.items() if factor.kind in ("gauge", "datum")] == [
        DATUM
    ]
    away = road.errors(second, [*truth, *true])
    assert np.sqrt(np.mean(away[120:] ** 2)) < 0.25
    before, after = (each.snapshot().trajectory.sevens[:120, :3] for each in (first, second))
    np.testing.assert_allclose(after, before, atol=0.02)


def test_a_second_drive_is_apart_until_its_fixes_tell_the_yaw(road, space):
    first = road.backend(space)
    road.run(first, road.drive(space)[0])
    second = road.backend(space)
    second.load(first.saved(NOTHING))
    decisions = road.run(second, another(road, space, seconds=4)[0])
    assert len(second.parts) == 2
    assert all("yaw not yet observable" in d.detail for d in decisions)
    assert {d.verdict for d in decisions} == {"probation", "refused"}


def test_the_earth_of_a_second_drive_moves_with_it_when_a_loop_joins_a_map_without_fixes(road, loop, space):
    """Nothing but the map's own first pose holds it."""
    items, truth = road.drive(space)
    first = road.backend(space)
    road.run(first, [item for item in items if not isinstance(item, Fix)])
    second = road.backend(space, sources={"loops": {"kind": "relative"}}, earth={"origin": road.origin})
    second.load(first.saved(NOTHING))
    later, true = another(road, space)
    shape, end = SPACES[space], later[-1].stamp
    seen, noise = frozen(shape.seven(truth[-1].between(true[-1]))), frozen(np.eye(6).ravel() * 1e-4)
    road.run(second, [*later, RelativePose(end, "loops", items[-1].stamp, end, "base", "base", seen, noise)])
    assert len(second.parts) == 1
    assert not [factor for factor in second.solver.factors.values() if factor.kind == "datum"]
    poses = [second.estimate.pose(k.pose) for k in second.timeline.keyframes]
    assert shape.size(poses[119].compose(truth[-1].between(true[-1])).between(poses[-1]))[0] < 0.1
    assert shape.size(poses[0])[0] < 0.01, "the map stays"
    away = road.errors(second, [*truth, *true])
    assert np.sqrt(np.mean(away[120:] ** 2)) < 0.25


@pytest.mark.parametrize("altitude", [np.nan, -np.inf, 1e308])
def test_in_the_plane_a_receiver_need_not_tell_a_height(road, altitude):
    """Its place on the ground is as good without; the estimate is the same to a millimetre."""
    items, _ = road.drive("2d")
    ends = []
    for height in (0.0, altitude):
        found = road.backend("2d")
        road.run(
            found,
            [replace(m, place=frozen((*m.place[:2], height))) if isinstance(m, Fix) else m for m in items],
        )
        ends.append(found.snapshot().trajectory.sevens)
    np.testing.assert_allclose(*ends, atol=1e-3)
