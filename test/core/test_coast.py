"""Nothing but positions: the robot goes on at constant velocity between them, and what is believed stays sane."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.graph import EARTH
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.gnss import Fix
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.space import SPACES
from slam_backend.io.replay import settled_stream

ORIGIN, SIGMA, STANDS, RATE = (42.3758, -71.1474, 12.0), 0.5, 8, 2  # s it stands, fixes per second


@pytest.fixture(params=["2d", "3d"])
def space(request):
    return request.param


def ride(seconds=80, seed=0):
    """A robot that stands, then winds its way at 4 m/s: its fixes, and where it was: x, y, z, yaw."""
    rng, place, yaw, fixes, truth = np.random.default_rng(seed), np.zeros(3), 2.5, [], []
    for k in range(seconds * RATE):
        if k >= STANDS * RATE:
            yaw += 0.1 * np.sin(k / RATE / 10) / RATE
            place = place + 4.0 / RATE * np.array([np.cos(yaw), np.sin(yaw), 0.02])
        truth.append((*place, yaw))
        fixes.append(fix(k, place + rng.normal(0, SIGMA, 3)))
    return fixes, np.array(truth)


def fix(k, place):
    where = frozen(pymap3d.enu2geodetic(*place, *ORIGIN))
    return Fix(SECOND + k * SECOND // RATE, "gps", "gps", where, frozen(np.eye(3) * SIGMA**2))


def configured(space, **more):
    sources = {"gps": {"kind": "gnss"}, **more.pop("sources", {})}
    data = {"space": space, "sources": list(sources), **sources, "earth": {"origin": ORIGIN}}
    return config_from({**data, **more})


def run(config, items):
    """Through the firewall, as everything goes."""
    found, decisions = Backend(config), []
    for item in settled_stream(items, config):
        if isinstance(item, Fix | AbsolutePose | LandmarkObservation):
            decisions += [told for update in found.add(item) for told in update.decisions]
        else:
            decisions.append(item)
    decisions += [told for update in found.finish() for told in update.decisions]
    found.polish()
    snapshot = found.snapshot()
    at = (snapshot.trajectory.stamps - SECOND) * RATE / SECOND
    return SimpleNamespace(
        backend=found, decisions=decisions, poses=snapshot.trajectory.sevens, rows=np.round(at).astype(int),
        compared=found.compared(snapshot), reasons={f"{d.stage}/{d.reason}" for d in decisions},
    )  # fmt: skip


def away(found, truth):
    """(N,) m in the plane between antennas, as estimated at each fix, and where they were."""
    rows = np.round((found.compared.stamps - SECOND) * RATE / SECOND).astype(int)
    return np.linalg.norm(found.compared.antennas[:, :2] - truth[rows, :2], axis=1)


def yaws(found):
    return 2 * np.arctan2(found.poses[:, 5], found.poses[:, 6])


def angle(radians):
    return (np.asarray(radians) + np.pi) % (2 * np.pi) - np.pi


def test_fixes_alone_make_a_path_that_is_better_than_they_are(space):
    fixes, truth = ride()
    found = run(configured(space), fixes)
    raw = np.linalg.norm(found.compared.fixes[:, :2] - truth[:, :2], axis=1)
    assert np.sqrt(np.mean(away(found, truth) ** 2)) < 0.7 * np.sqrt(np.mean(raw**2))
    assert {factor.kind for factor in found.backend.solver.factors.values()} >= {"motion", "gnss", "datum"}


def test_the_heading_is_unknown_until_the_robot_moves_and_then_its_course(space):
    fixes, truth = ride()
    found = run(configured(space), fixes)
    assert "coast/no_heading" in found.reasons
    moving = found.rows > (STANDS + 5) * RATE
    off = angle(yaws(found) - truth[found.rows, 3])[moving]
    assert np.sqrt(np.mean(off**2)) < 0.2
    standing = run(configured(space), fixes[: STANDS * RATE])
    covariance = standing.backend.estimate.covariance([standing.backend.timeline.keyframes[-1].pose])
    assert np.sqrt(covariance[2, 2]) > 1.0  # rad


def test_what_is_said_of_the_error_is_the_error(space):
    """Normalized squared errors of positions have the mean of chi-square, to within what correlation in time allows."""
    squares = []
    for seed in range(6):
        fixes, truth = ride(seed=seed)
        found = run(configured(space), fixes).backend
        for keyframe in found.timeline.keyframes[20::12]:
            pose, at = found.estimate.pose(keyframe.pose), found.space.translation
            k = round((keyframe.stamp - SECOND) * RATE / SECOND)
            map_T_earth = found.estimate.pose(EARTH)
            there = map_T_earth.transformFrom(truth[k, : found.space.point_dimension])
            error = pose.rotation().matrix().T @ (there - pose.translation())
            covariance = found.estimate.covariance([keyframe.pose])[at, at]
            squares.append(error @ np.linalg.solve(covariance, error) / len(error))
    assert 0.3 < np.mean(squares) < 1.7


def test_an_outage_is_bridged_and_what_comes_after_is_believed(space):
    fixes, truth = ride()
    found = run(configured(space, gps={"kind": "gnss", "withhold": [[30, 45]]}), fixes)
    after = found.compared.stamps > 52 * SECOND
    assert np.isfinite(found.compared.antennas).all()
    assert away(found, truth)[after].max() < 4 * SIGMA
    assert away(found, truth)[found.compared.withheld].max() < 25.0  # m, of 60 m on a bend
    shorter = run(configured(space, gps={"kind": "gnss", "withhold": [[30, 33]]}), fixes)
    assert away(shorter, truth)[shorter.compared.withheld].max() < 3.0


def test_a_first_fix_that_is_far_off_moves_nothing_and_nan_is_refused(space):
    fixes, truth = ride()
    bad = fix(-1, np.array([3_000.0, -1_000.0, 50.0]))
    broken = replace(fixes[50], place=frozen(np.array([np.nan] * 3)))
    found = run(configured(space), [bad, *fixes[:50], broken, *fixes[51:]])
    assert found.rows[0] == 0
    used = found.compared.stamps >= fixes[0].stamp
    away = (
        found.compared.antennas[used, :2] - truth[(found.compared.stamps[used] - SECOND) * RATE // SECOND, :2]
    )
    assert np.linalg.norm(away, axis=1).max() < 4 * SIGMA
    assert "check/not_finite" in found.reasons
    assert any(d.verdict == "refused" and d.stamp == bad.stamp for d in found.decisions)


def test_fixes_that_go_on_elsewhere_are_believed_in_the_end_and_said_to(space):
    """A receiver that leaps by 500 m and stays there."""
    fixes, truth = ride()
    shift = np.array([400.0, 300.0, 0.0])
    rng = np.random.default_rng(9)
    leapt = [fix(k, truth[k, :3] + shift + rng.normal(0, SIGMA, 3)) for k in range(80, len(fixes))]
    found = run(configured(space), [*fixes[:80], *leapt])
    assert "coast/restart" in found.reasons
    end = found.compared.antennas[-20:, :2] - (truth[-20:, :2] + shift[:2])
    assert np.linalg.norm(end, axis=1).max() < 4 * SIGMA


def test_absolute_poses_drive_too_and_tell_the_heading(space):
    _, truth = ride()
    rng, shape, items = np.random.default_rng(2), SPACES[space], []
    covariance = frozen(np.diag([SIGMA**2] * 3 + [0.05**2] * 3).ravel())
    for k, true in enumerate(truth):
        x, y, z, yaw = true + rng.normal(0, 1, 4) * (SIGMA, SIGMA, SIGMA, 0.05)
        seven = frozen(shape.seven(shape.from_extrinsics((x, y, z, 0.0, 0.0, yaw))))
        items.append(AbsolutePose(SECOND + k * SECOND // RATE, "amcl", "", seven, covariance))
    found = run(config_from({"space": space, "sources": ["amcl"], "amcl": {"kind": "pose"}}), items)
    error = found.poses[:, :2] - truth[found.rows, :2]
    assert np.sqrt(np.mean((error**2).sum(axis=1))) < 0.9 * SIGMA * np.sqrt(2)
    assert np.abs(angle(yaws(found) - truth[found.rows, 3])).max() < 0.3


def test_landmarks_land_between_fixes_and_are_where_they_are(space):
    fixes, truth = ride()
    items, tree = list(fixes), np.array([-60.0, 20.0, 1.0])
    for k in range(30, 140, 3):  # half way between two fixes
        x, y, z, yaw = (truth[k] + truth[k + 1]) / 2
        c, s = np.cos(yaw), np.sin(yaw)
        seen = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ (tree - (x, y, z))
        stamp = SECOND + (2 * k + 1) * SECOND // (2 * RATE)
        items.append(
            LandmarkObservation(stamp, "trees", "", "oak", "position", frozen(seen), frozen(np.eye(3) * 0.1))
        )
    items.sort(key=lambda item: item.stamp)
    found = run(configured(space, sources={"trees": {"kind": "landmark"}}), items)
    snapshot, map_T_earth = found.backend.snapshot(), found.backend.estimate.pose(EARTH)
    n = found.backend.space.point_dimension
    assert snapshot.names == ("oak",)
    assert np.linalg.norm(map_T_earth.transformTo(snapshot.landmarks[0][:n]) - tree[:n]) < 3.0


def test_the_same_fixes_end_in_the_same_bits(space):
    fixes, _ = ride(40)
    one, other = (run(configured(space), fixes).poses for _ in range(2))
    np.testing.assert_array_equal(one, other)
