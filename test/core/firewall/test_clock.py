"""One wrong stamp of the driving source costs one message; a clock that was really set goes on from there."""

import numpy as np
import pytest

from slam_backend.core.firewall.clock import Clock
from slam_backend.core.firewall.continuity import Pace
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, Measurement, frozen
from slam_backend.core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from slam_backend.core.space import SPACES


def judged(*seconds: float, lag: float = 0.2, end: bool = True) -> list[str]:
    """What is believed, as seconds, and rules with their verdict."""
    clock = Clock(round(lag * SECOND))
    out = [each for s in seconds for each in clock.judge(Measurement(round(s * SECOND), "wheels"))]
    out += clock.end() if end else ()
    return [
        f"{i.verdict} {i.reason}@{i.stamp / SECOND:g}" if isinstance(i, Decision) else f"{i.stamp / SECOND:g}"
        for i in out
    ]


def test_steady_stamps_pass_in_their_order_none_held_back_but_the_first():
    clock = Clock(0)
    first, second, third = (Measurement(n * SECOND, "wheels") for n in (1, 2, 3))
    assert clock.judge(first) == ()
    assert clock.judge(second) == (first, second)
    assert clock.judge(third) == (third,)


def test_a_lone_leap_is_refused_and_the_rest_goes_on():
    assert judged(1, 1.1, 9e8, 1.2, 1.3) == ["1", "1.1", "refused jump@9e+08", "1.2", "1.3"]


def test_two_different_leaps_in_a_row_are_both_refused():
    assert judged(1, 1.1, 500, 9e8, 1.2) == ["1", "1.1", "refused jump@500", "refused jump@9e+08", "1.2"]


def test_a_first_stamp_from_the_far_future_is_refused():
    assert judged(9e8, 1, 1.1) == ["refused jump@9e+08", "1", "1.1"]


def test_a_pause_is_no_error_and_a_long_one_is_noted():
    assert judged(1, 1.1, 4, 4.1) == ["1", "1.1", "4", "4.1"]
    assert judged(1, 1.1, 40, 40.1) == ["1", "1.1", "accepted gap@40", "40", "40.1"]


def test_a_clock_that_is_set_ahead_is_told_once_and_believed():
    assert judged(1, 1.1, 1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2)[2:] == [
        "accepted clock_jump@1.7e+09", "1.7e+09", "1.7e+09", "1.7e+09",
    ]  # fmt: skip


def test_a_clock_that_is_set_back_is_told_once():
    """Settling refuses each of these messages; here the second says why."""
    assert judged(100, 100.1, 1, 1.1, 1.2) == ["100", "100.1", "1", "refused clock_jump@1.1", "1.2"]


def test_what_is_a_little_out_of_order_is_left_to_settling():
    assert judged(1, 1.1, 1.05, 1.2) == ["1", "1.1", "1.05", "1.2"]
    assert judged(1, 1.1, 30, 20, 31, lag=60) == ["1", "1.1", "30", "20", "31"]


@pytest.mark.parametrize("period", [0.005, 2, 30, 600])
def test_a_source_of_any_rate_passes_whole(period):
    seconds = [1 + period * n for n in range(20)]
    assert [s for s in judged(*seconds) if "@" not in s] == [f"{s:g}" for s in seconds]


def test_a_leap_at_the_end_has_no_witness():
    assert judged(1, 1.1, 1.2, 50) == ["1", "1.1", "1.2", "refused jump@50"]
    assert judged(1, 50) == ["1", "accepted gap@50", "50"]
    assert judged(7) == ["7"]
    assert judged(7, end=False) == []


def test_nothing_is_lost_without_a_word():
    """Whatever the stamps: every message is believed or refused, once, and only the newest may still wait."""
    rng = np.random.default_rng(5)
    for _ in range(200):
        clock, told = Clock(0), 0
        stamps = (rng.choice([1e9, 1e10, 1e18], 30) + rng.integers(0, 40, 30) * 1e8).astype(np.int64)
        for stamp in stamps.tolist():
            out = clock.judge(Measurement(stamp, "wheels"))
            told += sum(not isinstance(i, Decision) or i.verdict == "refused" for i in out)
        told += sum(not isinstance(i, Decision) or i.verdict == "refused" for i in clock.end())
        assert told == len(stamps)


# -- pace ----------------------------------------------------------------------------------------------------------


def at(seconds: float, x: float, frame: str = "odom") -> OdometryPose:
    pose = frozen((x, 0, 0, 0, 0, 0, 1))
    return OdometryPose(round(seconds * SECOND), "wheels", frame, "base", pose, UNKNOWN, STILL, UNKNOWN)


def paced(*items: OdometryPose) -> list[str]:
    clock = Clock(SECOND // 5, Pace(2.0, SPACES["2d"]))
    out = [each for item in items for each in clock.judge(item)]
    out += clock.end()
    return [
        f"{i.verdict} {i.stage}/{i.reason}@{i.stamp / SECOND:g}" if isinstance(i, Decision) else f"{i.stamp / SECOND:g}"
        for i in out
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("lure", "rule"), [(at(1.9, 500), "teleport"), (at(1.9, 0.2, "elsewhere"), "frame_changed")]
)
def test_one_message_from_elsewhere_does_not_carry_the_clock_ahead(lure: OdometryPose, rule: str) -> None:
    assert paced(at(1, 0), at(1.1, 0.1), lure, at(1.2, 0.2)) == [
        "1", "1.1", f"refused recheck/{rule}@1.9", "1.2",
    ]  # fmt: skip
    clock = Clock(0, Pace(2.0, SPACES["2d"]))
    for item in (at(1, 0), at(1.1, 0.1), lure):
        clock.judge(item)
    assert clock.newest == at(1.1, 0).stamp


def test_elsewhere_is_believed_when_the_next_message_comes_from_there_too() -> None:
    assert paced(at(1, 0), at(1.1, 0), at(1.2, 500), at(1.3, 500)) == ["1", "1.1", "1.2", "1.3"]


def test_the_same_message_again_is_no_witness_and_no_contradiction() -> None:
    assert paced(at(1, 0), at(1.1, 0), at(1.2, 500), at(1.2, 500), at(1.3, 500)) == [
        "1", "1.1", "refused recheck/duplicate@1.2", "1.2", "1.3",
    ]  # fmt: skip


def test_two_frames_on_one_topic_do_not_keep_the_clock_from_going_on_after_a_pause() -> None:
    pairs = [at(s, 0, frame) for s in (1, 1.1, 40, 40.1, 40.2, 40.3) for frame in ("odom", "other")]
    assert [s for s in paced(*pairs) if " " not in s and float(s) > 2][:1] == ["40"]


def test_an_older_message_from_elsewhere_is_left_to_its_turn() -> None:
    assert paced(at(1, 0), at(1.1, 0), at(1.05, 500), at(1.2, 0)) == ["1", "1.1", "1.05", "1.2"]
