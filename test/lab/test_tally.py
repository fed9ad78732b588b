"""The tally of a run's verdicts, when it is known which loops are wrong."""

from slam_backend.core.graph import Decision
from slam_backend.lab.tally import Tally

LABELS = {(0, 10): "true", (1, 11): "true", (2, 12): "wrong", (3, 13): "wrong", (4, 14): "neither"}


def said(n, verdict):
    return Decision(n, f"loops/{n}", "loops", verdict, "test", "because", ends=(n, n + 10))


def tallied(*updates):
    tally = Tally(LABELS.__getitem__)
    for keyframes, decisions in enumerate(updates, start=100):
        tally.take([said(*each) for each in decisions], keyframes)
    return tally


def test_what_counts_is_the_last_verdict():
    tally = tallied([(0, "accepted"), (2, "accepted")], [(2, "removed"), (1, "probation")], [(1, "accepted")])
    assert (tally.true, tally.true_kept, tally.wrong_kept) == (2, 2, 0)
    assert (tally.precision, tally.recall) == (1.0, 1.0)
    assert tally.loops["loops/1"].rule == "test/because"


def test_a_wrong_loop_that_was_kept_for_a_moment_is_not_forgotten():
    tally = tallied([(2, "accepted")], [(3, "accepted"), (2, "removed")], [(3, "removed")])
    assert (tally.wrong_kept, tally.wrong_ever, tally.wrong_at_most) == (0, 2, 1)
    assert tally.precision == 1.0


def test_precision_and_recall_leave_out_what_nobody_can_label():
    tally = tallied([(0, "accepted"), (1, "refused"), (2, "accepted"), (4, "accepted")])
    assert (tally.precision, tally.recall) == (0.5, 0.5)


def test_delays_are_in_keyframes_from_the_first_verdict_of_true_loops():
    tally = tallied(
        [(0, "accepted"), (1, "probation"), (2, "probation")], [], [(1, "accepted"), (2, "accepted")]
    )
    assert tally.delays.tolist() == [0, 2]


def test_decisions_about_records_are_not_about_loops():
    tally = Tally(LABELS.__getitem__)
    tally.take([Decision(0, "imu/0", "imu", "refused", "check", "nan")], 1)
    assert tally.loops == {}
    assert (tally.precision, tally.recall) == (1.0, 1.0)
