"""Commands: what a person asks is a record of the stream, understood or refused, and done in its place."""

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.command import command, parse, text_of
from slam_backend.core.config import Config
from slam_backend.core.errors import BadMessage
from slam_backend.core.measurement import SECOND, Measurement
from slam_backend.core.settle import settled


def driven(items):
    backend = Backend(Config(robust=()))  # the loops of `laps` are to be believed as they are
    for item in items:
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


def test_an_optimization_ends_at_the_optimum_and_says_what_it_did(laps):
    backend = driven(laps)
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


def test_the_drive_goes_on_from_the_optimum(laps):
    """What comes after a command is solved from its outcome: another estimate than without it, the same graph."""
    half, without = driven(laps[:50]), driven(laps[:50])
    half.add(command("1", "optimize", {}))
    newest = half.timeline.newest.pose
    assert not half.estimate.pose(newest).equals(without.estimate.pose(newest), 1e-12)
    for backend in (half, without):
        for item in (*laps[50:], command("end", "optimize", {})):
            backend.add(item)
    assert half.solver.factors.keys() == without.solver.factors.keys()
    assert half.snapshot().trajectory.sevens == pytest.approx(without.snapshot().trajectory.sevens, abs=1e-6)


def test_a_command_that_cannot_be_done_is_refused_and_changes_nothing(laps):
    backend = driven(laps)
    before = backend.snapshot().trajectory.sevens
    decision = backend.add(command("1", "explode", {}))[-1].decisions[-1]
    assert (decision.verdict, decision.reason) == ("refused", "explode")
    assert "optimize" in decision.detail
    assert np.array_equal(backend.snapshot().trajectory.sevens, before)


def test_a_command_before_the_first_keyframe_is_refused_with_it(laps):
    backend = Backend()
    assert backend.add(command("1", "optimize", {})) == []
    first = next(update for item in laps for update in backend.add(item))
    decisions = [d for d in first.decisions if d.stage == "command"]
    assert [(d.id, d.verdict) for d in decisions] == [("command/1", "refused")]
