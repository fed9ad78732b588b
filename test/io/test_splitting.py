"""A landmark that becomes two: the same from a bag and from its journal, and both in all that is written."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.measurement import frozen
from slam_backend.core.query import answers
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.bags import open_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.journal import Journal
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import simulate, write_simulation

OPTIONS = Options(poses=420, landmark_sigma=0.05, landmark_range=12.0, loop_rate=0.0, landmarks=25)
AWAY = np.array([1.5, -1.0, 0.0])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive on which the landmark that is seen most often is carried away after its 20th sighting: its name, and what was written."""
    simulation = simulate("square", 2, OPTIONS)
    seen = Counter(
        each.landmark for sent in simulation.sent if sent.topic == "/landmarks" for each in sent.content
    )
    name = seen.most_common(1)[0][0]
    poses = dict(
        zip(simulation.stamps.tolist(), Trajectory(simulation.stamps, simulation.sevens).poses, strict=True)
    )
    since = sorted(
        each.stamp
        for sent in simulation.sent
        if sent.topic == "/landmarks"
        for each in sent.content
        if each.landmark == name
    )[20]

    def told(sent):
        if sent.topic != "/landmarks" or sent.content[0].stamp < since:
            return sent
        aside = AWAY @ poses[sent.content[0].stamp][:3, :3]
        moved = tuple(
            replace(each, value=frozen(each.value + aside)) if each.landmark == name else each
            for each in sent.content
        )
        return sent._replace(content=moved)

    folder = tmp_path_factory.mktemp("drive")
    simulation = replace(simulation, sent=tuple(map(told, simulation.sent)))
    return name, folder, write_simulation(simulation, folder / "drive.mcap")


@pytest.fixture(scope="module")
def result(drive):
    _, _, written = drive
    return replay(written.bag, load_config(written.config)).result


def test_a_journal_gives_the_run_that_its_bag_gives(drive, result) -> None:
    """To the bit, the split included."""
    _, folder, written = drive
    journal = Journal(folder / "journal", pytest.fail)
    with open_bag(written.bag) as bag:
        for record in bag.records():
            journal.append(record.topic, record.type, record.data)
    journal.close()
    again = replay(journal.path, load_config(written.config)).result
    assert "splitting/moved" in result.decisions.by_rule()
    assert again.summary["run_hash"] == result.summary["run_hash"]


def test_a_finished_run_answers_for_both_places(drive, result) -> None:
    """And for the decision that made them, under the name of the new one."""
    name, folder, _ = drive
    write_run(result, folder / "run")
    run = FinishedRun(folder / "run")
    first, second, decision = (
        answer.value
        for answer in answers([f"landmark/{name}", f"landmark/{name}~2", f"decision/landmarks/{name}~2"], run)
    )
    np.testing.assert_allclose(second - first, AWAY, atol=0.4)
    assert decision["reason"] == "moved"
    assert decision["basis"]["from"] == name
