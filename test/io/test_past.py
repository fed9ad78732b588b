"""What was believed at t is what a replay believes of an input that is cut there: to the bit, whatever came later."""

from pathlib import Path

import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.core.measurement import SECOND
from slam_backend.core.query import Unknown, answers
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.cdr import Decoder
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.inputs import open_inputs
from slam_backend.io.past import Past
from slam_backend.io.replay import Cut, Run, replay
from slam_backend.io.rundir import write_run
from slam_backend.io.typestore import typestore_of
from slam_backend.lab.simulate import Options, simulate, write_simulation

LATE = Options(poses=300, loop_rate=0.3, landmarks=30, dropout=0.05, late=0.1, late_delay=0.3)  # lag: 0.1 s
SHARES = (0.5, 0.6180339, 0.75, 0.9)  # of the drive: where to look back


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive with loops and landmarks, some of which come later than the lag; and its finished run."""
    folder = tmp_path_factory.mktemp("drive")
    written = write_simulation(simulate("square", 3, LATE), folder / "drive.mcap")
    config = load_config(written.config)
    assert config.settle.lag < LATE.late_delay
    result = replay(written.bag, config, final="batch").result
    write_run(result, folder / "run")
    first, last = (int(result.trajectory.stamps[n]) for n in (0, -1))
    return written.bag, config, folder / "run", [round(first + share * (last - first)) for share in SHARES]


def records(bag):
    with open_bag(bag) as opened:
        return list(opened.records())


def stamped(config, found):
    """(record, stamp, whether it drives) of what the configuration uses."""
    table = {source.topic: (name, source.kind) for name, source in config.sources.items()}
    decoder = Decoder(typestore_of(()), table)
    for record in found:
        for measurement in decoder.decode(record)[:1]:
            yield record, measurement.stamp, measurement.source == config.driver


def those_in(config, found):
    """The configuration without sources of which there is nothing yet, at which a replay would balk."""
    topics = {record.topic for record in found}
    sources = {name: source for name, source in config.sources.items() if source.topic in topics}
    return config.model_copy(update={"sources": sources})


def assert_same(mine, other):
    assert mine.trajectory.stamps.tolist() == other.trajectory.stamps.tolist()
    assert mine.trajectory.sevens.tobytes() == other.trajectory.sevens.tobytes()
    assert mine.indices.tolist() == other.indices.tolist()
    assert dict(zip(mine.names, mine.landmarks.tolist(), strict=True)) == dict(
        zip(other.names, other.landmarks.tolist(), strict=True)
    )
    wanted = np.linspace(mine.stamps[0], mine.stamps[-1], 50).astype(np.int64)
    assert mine.at(wanted).tobytes() == other.at(wanted).tobytes()


def test_the_belief_at_t_is_that_of_an_input_which_is_cut_when_the_watermark_passes_t(drive, tmp_path):
    bag, config, run, stamps = drive
    finished, lag = FinishedRun(run), round(config.settle.lag * SECOND)
    for n, t in enumerate(stamps):
        used = list(stamped(config, records(bag)))
        passing = next(i for i, (_, stamp, drives) in enumerate(used) if drives and stamp - lag > t)
        come = [record for record, _, _ in used[: passing + 1]]
        write_bag(tmp_path / f"{n}.mcap", come)
        with open_inputs([tmp_path / f"{n}.mcap"]) as inputs:
            cut = Run(inputs, those_in(config, come), [], cut=Cut(flush=False))
            assert cut.reach(t)
            assert_same(finished.past(t).snapshot, cut.backend.snapshot())


def test_without_late_messages_it_is_that_of_the_messages_up_to_t(tmp_path):
    options = Options(poses=200, loop_rate=0.3, landmarks=20, late=0.1, late_delay=0.05)
    written = write_simulation(simulate("spiral", 4, options), tmp_path / "drive.mcap")
    config = load_config(written.config)
    used = list(stamped(config, records(written.bag)))
    for t in (used[len(used) // 2][1], used[3 * len(used) // 4][1] + 1):
        early = [record for record, stamp, _ in used if stamp <= t]
        write_bag(tmp_path / f"{t}.mcap", early)
        whole, cut = replay(written.bag, config), replay(tmp_path / f"{t}.mcap", those_in(config, early))
        assert whole.reach(t)
        cut.reach(t)
        assert_same(whole.backend.snapshot(), cut.backend.snapshot())
        (tmp_path / f"{t}.mcap").unlink()


def test_a_graph_that_drives_itself_has_the_vertex_at_t(tmp_path):
    """Nothing says that the edges of a vertex are complete but an edge of a later one, or that t has passed."""
    rng = np.random.default_rng(5)
    edges = [(n, n + 1) for n in range(40)] + [(n, n + 7) for n in range(0, 33, 4)]
    lines = [f"VERTEX_SE2 {n} {n} 0 0" for n in range(41)] + [
        f"EDGE_SE2 {a} {b} {b - a + rng.normal(0, 0.1)} {rng.normal(0, 0.1)} 0 100 0 0 100 0 100"
        for a, b in edges
    ]
    (tmp_path / "whole.g2o").write_text("\n".join(lines))
    whole = replay(tmp_path / "whole.g2o").result
    t = int(whole.trajectory.stamps[20])
    kept = [line for line in lines if max(map(int, line.split()[1 : 2 + line.startswith("EDGE")])) <= 20]
    (tmp_path / "cut.g2o").write_text("\n".join(kept))
    run, cut = replay(tmp_path / "whole.g2o"), replay(tmp_path / "cut.g2o")
    assert run.reach(t)
    assert cut.reach(t)
    assert len(run.backend.timeline) == 21
    assert_same(run.backend.snapshot(), cut.backend.snapshot())


@pytest.mark.parametrize("source", ["drive", "graph"])
def test_to_stop_on_the_way_changes_nothing(drive, tmp_path, source):
    bag, config, run, stamps = drive
    if source == "graph":
        bag, config = run / "graph.g2o", None
        stamps = [n * SECOND // 10 + SECOND for n in (1, 5, 50, 200)]
    halting = replay(bag, config)
    for stamp in stamps:
        halting.reach(stamp)
        halting.backend.snapshot()
    assert halting.result.summary["run_hash"] == replay(bag, config).result.summary["run_hash"]


def test_names_are_answered_as_of_then(drive):
    """Poses, covariances, landmarks and decisions: what came later is unknown."""
    bag, config, run, (early, _, middle, _) = drive
    finished, then = FinishedRun(run), replay(bag, config)
    then.reach(middle)
    snapshot, name = then.backend.snapshot(), f"map@{middle // SECOND}.{middle % SECOND:09d}"
    loop = next(id_ for id_, factor in then.backend.solver.factors.items() if factor.kind == "loop")
    asked = [
        "pose@now",
        "pose@k3",
        "pose@k3#cov",
        f"landmark/{snapshot.names[0]}",
        f"decision/{loop}",
        "pose@k299",
    ]
    found = answers([*(f"{name}/{each}" for each in asked), "pose@k3"], finished)
    last, third, covariance, landmark, decision, unknown, now = (each.value for each in found)
    assert last.tobytes() == snapshot.trajectory.sevens[-1].tobytes()
    assert third.tobytes() == snapshot.trajectory.sevens[3].tobytes()
    assert np.abs(now - third).max() > 1e-6, "the belief has changed since"
    assert covariance.shape == (6, 6)
    assert landmark.tobytes() == snapshot.landmarks[0].tobytes()
    assert decision["verdict"] == "accepted"
    assert unknown is None
    assert answers([f"map@k{0}/decision/{loop}"], finished)[0].value is None
    assert early < middle


def test_one_replay_serves_what_is_asked_in_order_and_an_earlier_stamp_another(drive):
    bag, config, _, stamps = drive
    begun = []

    def begin():
        begun.append(replay(bag, config))
        return begun[-1]

    past = Past(begin)
    forth = [past.at(stamp).snapshot for stamp in stamps]
    assert len(begun) == 1
    back = past.at(stamps[0]).snapshot
    assert len(begun) == 2
    assert_same(back, forth[0])


def test_where_the_run_never_was_nothing_is_known(drive):
    _, _, run, stamps = drive
    finished = FinishedRun(run)
    with pytest.raises(Unknown, match=r"nothing was applied at .*: the input ends at"):
        finished.past(int(finished.trajectory.stamps[-1]) + 60 * SECOND)
    with pytest.raises(Unknown, match=r"there was no keyframe yet at 1\.000000000"):
        finished.past(SECOND)
    assert finished.past(stamps[0]).trajectory.stamps[-1] <= stamps[0], "it can be asked again"


def test_inputs_that_have_moved_or_changed_are_said_in_one_line(drive, tmp_path):
    bag, config, _, stamps = drive
    copy = tmp_path / "drive.mcap"
    write_bag(copy, records(bag))
    write_run(replay(copy, config).result, tmp_path / "run")
    copy.rename(tmp_path / "elsewhere.mcap")
    with pytest.raises(
        BadFile, match=r"run: what was believed earlier .*drive\.mcap is not there; put it back"
    ):
        FinishedRun(tmp_path / "run").past(stamps[1])
    write_bag(copy, records(bag)[50:])
    with pytest.raises(BadFile, match=r"takes another way: the inputs have changed"):
        FinishedRun(tmp_path / "run").past(stamps[1])


def test_a_difference_names_what_came_between_and_how_far_things_moved(drive):
    bag, config, run, (_, first, last, _) = drive
    found = FinishedRun(run).between(first, last)
    before, after = replay(bag, config), replay(bag, config)
    before.reach(first)
    after.reach(last)
    old, new = before.backend.solver.factors, after.backend.solver.factors
    assert {event.id for event in found.events} == {
        id_ for id_, factor in new.items() if id_ not in old and factor.kind == "loop"
    }
    assert sum(found.came.values()) == len(new) - len(old)
    assert not found.went
    here, there = before.backend.snapshot(), after.backend.snapshot()
    both = np.isin(there.stamps, here.stamps)
    expected = np.linalg.norm(there.trajectory.sevens[both, :3] - here.trajectory.sevens[:, :3], axis=1)
    np.testing.assert_allclose(found.meters, expected, atol=1e-12)
    assert found.moved > 10
    assert max(event.jump.meters for event in found.events) > 1e-3


def test_a_path_is_not_needed_to_be_absolute(drive, tmp_path, monkeypatch):
    """A run says where its inputs were, wherever it is asked from."""
    bag, config, _, stamps = drive
    monkeypatch.chdir(bag.parent)
    write_run(replay(Path(bag.name), config).result, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    assert len(FinishedRun(tmp_path / "run").past(stamps[0]).trajectory)
