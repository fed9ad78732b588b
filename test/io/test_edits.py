"""The journal of a run's edits, and which measurement of the input has which id."""

import numpy as np
import pytest

from slam_backend.core.command import command
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadFile
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.io.edits import NONE, Edits, arrivals, kept, read_edits, without, write_edits
from slam_backend.io.replay import settled_stream

CONFIG = config_from(
    {"sources": ["odometry", "loops"], "odometry": {"kind": "odometry"}, "loops": {"kind": "relative"}}
)


def test_edits_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "edits.jsonl"
    edits = Edits(
        {7: "loops/1.000000000/0"}, (command("1", "edit", {"disable": ["all"]}), command("2", "undo", {}))
    )
    write_edits(path, edits)
    again = read_edits(path)
    assert again.dropped == edits.dropped
    assert [(c.id, c.action, c.arguments) for c in again.commands] == [
        (c.id, c.action, c.arguments) for c in edits.commands
    ]
    assert len(again) == 3
    write_edits(path, NONE)
    assert not path.exists()
    assert read_edits(path) == NONE


@pytest.mark.parametrize(
    "line",
    [
        "",
        "nonsense",
        "{}",
        '{"version": 1, "id": "0", "action": "without", "arguments": {"measurements": [1]}}',
    ],
)
def test_a_damaged_line_is_said_with_its_number(tmp_path, line):
    path = tmp_path / "edits.jsonl"
    write_edits(path, Edits({}, (command("1", "undo", {}),)))
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(BadFile, match=r"edits\.jsonl:2: is damaged"):
        read_edits(path)


def items():
    """Odometry by the second; three loops with the stamp of the fifth, one of them nonsense, arriving one by one."""
    identity, zero = np.array([0, 0, 0, 0, 0, 0, 1.0]), np.zeros(36)
    for n in range(1, 11):
        pose = np.array([n, 0, 0, 0, 0, 0, 1.0])
        yield OdometryPose(n * SECOND, "odometry", "odom", "base", pose, UNKNOWN, STILL, UNKNOWN)
        if n in (6, 7, 8):
            value = identity * np.nan if n == 7 else identity
            yield RelativePose(5 * SECOND, "loops", n, 5 * SECOND, "", "", value, zero)
            yield Decision(0, "x", "x", "refused", "decode", "x")


def test_an_id_leads_to_the_measurement_that_has_it():
    """Behind the firewall: the nonsense between the two has no id. Without the first, the second takes its place."""
    ids = {"loops/5.000000000/0", "loops/5.000000000/1", "loops/5.000000000/2", "odometry/3.000000000/0"}
    assert arrivals(items(), CONFIG, (), ids, settled_stream) == {
        "loops/5.000000000/0": 6,
        "loops/5.000000000/1": 10,
    }
    assert arrivals(items(), CONFIG, (6,), ids, settled_stream) == {"loops/5.000000000/0": 10}
    assert without("loops/5.000000000/1", ["loops/5.000000000/0"]) == "loops/5.000000000/0"
    assert without("trees/5.000000000/1:4", ["trees/5.000000000/0"]) == "trees/5.000000000/0:4"
    assert (
        without("loops/5.000000000/1", ["loops/5.000000000/2", "gps/5.000000000/0"]) == "loops/5.000000000/1"
    )


def test_what_is_dropped_is_gone_and_all_else_stays():
    everything, left = list(items()), list(kept(items(), {0, 10}))
    assert len(left) == len(everything) - 2
    assert sum(isinstance(item, Decision) for item in left) == 3
    assert left[0].stamp == 2 * SECOND
