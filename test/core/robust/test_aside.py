"""Judgments aside: begun and landed at keyframes that the data alone decide, told as decisions, finished at the end of the input."""

import pytest

from slam_backend.core.fingerprint import run_hash
from slam_backend.core.graph import Delta

from .conftest import ends

STAGES = ["gnc", "rrr"]


def stages(stage, every=40, lag=10):
    gap = {"gap": 3.5} if stage == "rrr" else {}
    return {"robust": [stage], stage: {"every": every, "lag": lag, **gap}}


def wrongs(drive):
    return drive.wrong((70, 30), (80, 40), (90, 50), (100, 20))


@pytest.mark.parametrize("stage", STAGES)
def test_wrong_loops_stay_out_and_true_ones_come_in(drive, stage):
    true, wrong = drive.true(2, 8), wrongs(drive)
    ended = drive.run([*true, *wrong], **stages(stage))
    assert ended.kept == ends(true)
    assert {ended.last[pair].verdict for pair in ends(wrong)} == {"refused"}
    assert all(ended.last[pair].detail for pair in ends(wrong))


@pytest.mark.parametrize("stage", STAGES)
def test_a_verdict_lands_a_fixed_number_of_keyframes_after_its_beginning(drive, stage):
    """Offered at 62 and later, begun at the 80th keyframe, landed at the 90th."""
    true = drive.true(2, 4, every=3)
    edges = [*drive.motion, *true]
    ended = drive.run(true, **stages(stage))
    entered = {}
    for every, lag, lands in ((40, 10, 90), (30, 5, 95), (25, 20, 95)):
        entered[every, lag] = _entry(drive, edges, stages(stage, every, lag))
        assert abs(entered[every, lag] - lands) <= 1, (every, lag)
    assert ended.kept == ends(true)


@pytest.mark.parametrize("stage", STAGES)
def test_what_a_person_takes_out_stays_out(drive, stage):
    """Though the next judgment would let it in again."""
    true = drive.true(2, 8)
    backend = drive.backend(**stages(stage, every=5, lag=2))
    for edge in sorted([*drive.motion, *true], key=lambda e: (e.stamp, abs(e.stamp_i - e.stamp_j))):
        backend.add(edge)
        if edge is true[5]:
            (gone,) = [f.id for f in backend.solver.factors.values() if f.stamps == true[1].ends]
            backend._applier.apply(Delta(remove=(gone,)))
    backend.finish()
    assert gone not in backend.solver.factors
    assert len([f for f in backend.solver.factors.values() if f.kind == "loop"]) == len(true) - 1


def _entry(drive, edges, settings):
    """The number of keyframes when the first loop entered."""
    backend = drive.backend(**settings)
    for edge in sorted(edges, key=lambda e: (e.stamp, abs(e.stamp_i - e.stamp_j))):
        for update in backend.add(edge):
            if any(d.ends and d.verdict == "accepted" for d in update.decisions):
                return len(backend.timeline)
    return None


@pytest.mark.parametrize("stage", STAGES)
def test_what_has_not_landed_when_the_input_ends_is_judged_then(drive, stage):
    true, wrong = drive.true(40, 6), wrongs(drive)
    ended = drive.run([*true, *wrong], **stages(stage, every=10_000))
    assert ended.kept == ends(true)


@pytest.mark.parametrize("stage", STAGES)
def test_a_wrong_loop_that_entered_is_removed_once_others_speak_against_it(drive, stage):
    """A metre off is within what sixty steps of odometry leave open; four steps to true loops leave less."""
    off = drive.space.from_extrinsics((0.7, 0.7, 0.0, 0.0, 0.0, 0.0))
    wrong, true = drive._edge(61, 1, off), drive.true(5, 10)
    ended = drive.run([wrong, *true], **stages(stage, every=2, lag=1))
    assert ended.kept == ends(true)
    assert [d.verdict for d in ended.decisions if d.ends == wrong.ends] == [
        "probation",
        "accepted",
        "removed",
    ]


@pytest.mark.parametrize("stage", STAGES)
def test_the_same_records_give_the_same_bits(drive, stage):
    loops = [*drive.true(2, 8), *wrongs(drive)]

    def bits():
        ended = drive.run(loops, **stages(stage))
        backend = ended.backend
        snapshot = backend.snapshot()
        factors = list(backend.solver.factors.values())
        return run_hash(factors, ended.decisions, backend.estimate.values(), snapshot.trajectory.sevens)

    assert bits() == bits()
