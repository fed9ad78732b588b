"""Commands: what a person asks is a record of the stream, understood or refused, and done in its place."""

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.command import command, parse, text_of
from slam_backend.core.errors import BadMessage
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, Measurement
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.settle import settled

SIDE = 8  # keyframes of each side of a square


def seven(x, y, yaw):
    return np.array([x, y, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])


def drive(laps=2, drift=0.02):
    """Around a square, the odometry turning a little too far; a loop at each corner after the first lap."""
    pose, heading, seen = np.zeros(2), 0.0, {}
    for n in range(laps * 4 * SIDE):
        stamp = (n + 1) * SECOND
        yield OdometryPose(stamp, "odometry", "odom", "base", seven(*pose, heading), UNKNOWN, STILL, UNKNOWN)
        place = n % (4 * SIDE)
        if place in seen and place % SIDE == 0:
            same = seven(0, 0, 0)
            yield RelativePose(stamp, "relative", seen[place], stamp, "base", "base", same, np.zeros(36))
        seen.setdefault(place, stamp)
        pose = pose + np.array([np.cos(heading), np.sin(heading)])
        heading += (np.pi / 2 if n % SIDE == SIDE - 1 else 0) + drift


def driven(until=None):
    backend = Backend()
    for n, item in enumerate(drive()):
        if n == until:
            break
        backend.add(item)
    return backend


def test_a_command_is_read_as_it_was_written():
    asked = command("17", "edit", {"disable": ["loops/1.000000000/0"], "dry_run": True})
    assert parse(text_of(asked)).arguments == asked.arguments
    assert (parse(text_of(asked)).id, parse(text_of(asked)).action) == ("17", "edit")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no JSON"),
        ("[1]", "no JSON object"),
        ("{}", "version None"),
        ('{"version": 2, "id": "1", "action": "optimize", "arguments": {}}', "version 2"),
        ('{"version": 1, "id": 1, "action": "optimize", "arguments": {}}', "'id' is 1"),
        ('{"version": 1, "id": "1", "arguments": {}}', "'action' is None"),
        ('{"version": 1, "id": "1", "action": "optimize", "arguments": []}', "'arguments'"),
    ],
)
def test_what_is_no_command_says_why(text, why):
    with pytest.raises(BadMessage, match=why):
        parse(text)


def test_a_command_keeps_its_place_of_arrival():
    """Measurements wait for the watermark; a command waits for nothing, and moves nothing."""
    odometry = [Measurement(n * SECOND, "odometry") for n in (1, 2, 3)]
    asked = command("1", "optimize", {})
    out = list(settled([*odometry[:2], asked, odometry[2]], "odometry", SECOND // 2))
    assert [each.stamp for each in out] == [SECOND, 0, 2 * SECOND, 3 * SECOND]
    assert out[1] is asked


def test_an_optimization_ends_at_the_optimum_and_says_what_it_did():
    backend = driven()
    before = backend.snapshot().trajectory.sevens
    updates = backend.add(command("1", "optimize", {}))
    decision = updates[-1].decisions[-1]
    told = decision.basis
    after = backend.snapshot().trajectory.sevens
    assert (decision.id, decision.verdict, decision.stage) == ("command/1", "accepted", "command")
    assert told["cost"]["after"] <= told["cost"]["before"]
    moved = np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max()
    assert told["largest_shift"]["m"] == pytest.approx(moved, rel=1e-6)
    again = backend.add(command("2", "optimize", {}))[-1].decisions[-1].basis
    assert again["largest_shift"]["m"] < 1e-8
    assert again["revision"] == told["revision"] == updates[-1].revision


def test_the_drive_goes_on_from_the_optimum():
    """What comes after a command is solved from its outcome: the same graph, and another estimate than without it."""
    with_, without = driven(), Backend()
    for n, item in enumerate(drive()):
        without.add(item)
        if n == 50:
            online = without.estimate.pose(without.timeline.newest.pose)
    half = driven(until=51)
    half.add(command("1", "optimize", {}))
    assert not half.estimate.pose(half.timeline.newest.pose).equals(online, 1e-12)
    for n, item in enumerate(drive()):
        if n > 50:
            half.add(item)
    assert half.solver.factors.keys() == with_.solver.factors.keys()
    for backend in (half, without):
        backend.add(command("end", "optimize", {}))
    assert half.snapshot().trajectory.sevens == pytest.approx(without.snapshot().trajectory.sevens, abs=1e-6)


def test_a_command_that_cannot_be_done_is_refused_and_changes_nothing():
    backend = driven()
    before = backend.snapshot().trajectory.sevens
    decision = backend.add(command("1", "explode", {}))[-1].decisions[-1]
    assert (decision.verdict, decision.reason) == ("refused", "explode")
    assert "optimize" in decision.detail
    assert np.array_equal(backend.snapshot().trajectory.sevens, before)


def test_a_command_before_the_first_keyframe_is_refused_with_it():
    backend = Backend()
    assert backend.add(command("1", "optimize", {})) == []
    first = next(update for item in drive() for update in backend.add(item))
    decisions = [d for d in first.decisions if isinstance(d, Decision) and d.stage == "command"]
    assert [(d.id, d.verdict) for d in decisions] == [("command/1", "refused")]
