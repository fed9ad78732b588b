"""Measurements leave in the order they were taken, whatever the order they came in."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.firewall.rules import MOST_WAITING
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, Measurement, StaticTransform, frozen
from slam_backend.core.settle import settled

DRIVER = "wheels"


def said(source, *stamps) -> list[Measurement]:
    return [Measurement(stamp, source) for stamp in stamps]


def wheels(*stamps):
    return said(DRIVER, *stamps)


def names(items) -> list[str]:
    """`source@stamp`, or the rule of a decision."""
    return [f"{i.stage}/{i.reason}" if isinstance(i, Decision) else f"{i.source}@{i.stamp}" for i in items]


def test_measurements_leave_by_stamp_and_the_driver_last_among_equals():
    """What belongs to a keyframe must be there when the keyframe is made."""
    items = [*wheels(1, 2), *said("loops", 2), *said("zebra", 2), *said("camera", 1), *wheels(9)]
    assert names(settled(items, DRIVER, lag=5)) == [
        "camera@1", "wheels@1", "loops@2", "zebra@2", "wheels@2", "wheels@9",
    ]  # fmt: skip


def test_measurements_of_one_source_and_stamp_keep_their_order():
    first, second, third = said("tags", 4, 4, 4)
    left = list(settled([first, second, third, *wheels(9)], DRIVER, lag=1))
    assert left[0] is first
    assert left[1] is second
    assert left[2] is third


def test_only_the_driver_moves_the_watermark():
    """After a stall loops arrive seconds ahead of the odometry: they wait for it."""
    stream = settled([*said("loops", 50, 60), *wheels(1, 2, 3)], DRIVER, lag=1, last_resort=False)
    assert names(stream) == ["wheels@1"]


def test_what_is_as_old_as_the_watermark_still_waits_for_its_equals():
    items = [*wheels(10), *said("loops", 8), *wheels(11), *said("loops", 9)]
    assert names(settled(items, DRIVER, lag=2, last_resort=False)) == ["loops@8"]


def test_without_lag_each_message_of_the_driver_releases_what_is_older():
    items = [*wheels(1), *said("loops", 1), *wheels(2), *said("loops", 2), *wheels(3)]
    left = list(settled(items, DRIVER, lag=0, last_resort=False))
    assert names(left) == ["loops@1", "wheels@1", "loops@2", "wheels@2"]


def test_what_comes_late_is_taken_at_once_and_marked():
    items = [*wheels(10, 20), *said("loops", 3), *wheels(30)]
    left = list(settled(items, DRIVER, lag=5))
    assert names(left) == ["wheels@10", "settle/late", "loops@3", "wheels@20", "wheels@30"]
    late = left[1]
    assert (late.verdict, late.id, late.source) == ("accepted", "loops/0.000000003", "loops")
    assert late.statistic == 12 / SECOND


def test_the_driver_itself_is_refused_when_late_but_not_within_the_lag():
    left = list(settled(wheels(10, 20, 16, 14, 30), DRIVER, lag=5))
    assert names(left) == ["wheels@10", "settle/backward", "wheels@16", "wheels@20", "wheels@30"]
    assert left[1].verdict == "refused"


def test_one_stamp_from_the_far_future_costs_one_message():
    far = wheels(1 << 60)
    left = names(settled([*wheels(10, 20), *far, *wheels(30, 40), *said("loops", 25)], DRIVER, lag=5))
    assert left == [
        "wheels@10", "settle/jump", "wheels@20", "wheels@30", "settle/late", "loops@25", "wheels@40",
    ]  # fmt: skip


def test_what_is_too_far_ahead_of_the_driver_is_refused():
    left = list(settled([*wheels(1, 2), *said("gps", 90, 120), *wheels(3)], DRIVER, lag=0, ahead=100))
    assert names(left) == ["wheels@1", "settle/ahead", "wheels@2", "wheels@3", "gps@90"]
    assert (left[1].statistic, left[1].threshold) == (118 / SECOND, 100 / SECOND)


def test_before_the_driver_has_spoken_nothing_is_ahead_of_it():
    assert names(settled([*said("gps", 1 << 60), *wheels(1, 2)], DRIVER, lag=0, ahead=1)) == [
        "wheels@1", "wheels@2", f"gps@{1 << 60}",
    ]  # fmt: skip


def test_of_a_flood_the_oldest_are_dropped_and_counted_and_no_other_source_suffers():
    flood = said("camera", *range(10, 10 + 2 * MOST_WAITING))
    left = list(settled([*wheels(1, 2), *said("loops", 5), *flood], DRIVER, lag=0))
    dropped = [item for item in left if isinstance(item, Decision)]
    kept = [item.stamp for item in left if isinstance(item, Measurement) and item.source == "camera"]
    assert {f"{d.source} {d.verdict} {d.reason}" for d in dropped} == {"camera refused flood"}
    assert sum(d.count for d in dropped) + len(kept) == len(flood)
    assert len(kept) <= MOST_WAITING
    assert kept == [item.stamp for item in flood[-len(kept) :]]
    assert [i.source for i in left if isinstance(i, Measurement) and i.source != "camera"] == [
        "wheels"
    ] * 2 + ["loops"]


def test_decisions_and_static_transforms_pass_at_once():
    seven = frozen((0, 0, 0, 0, 0, 0, 1))
    static = StaticTransform(0, "/tf_static", "base", "camera", seven)
    told = Decision(5, "x", "x", "refused", "check", "nan")
    left = list(settled([*wheels(5), static, told, *wheels(6)], DRIVER, lag=3, last_resort=False))
    assert left == [static, told]


def test_the_end_of_the_input_releases_everything_only_on_request():
    items = [*said("loops", 7), *wheels(5)]
    assert names(settled(items, DRIVER, lag=1)) == ["wheels@5", "loops@7"]
    assert not list(settled(items, DRIVER, lag=1, last_resort=False))
    assert not list(settled([], DRIVER, lag=1))


@given(seed=st.integers(0, 2**32 - 1), lag=st.integers(0, 40))
def test_shuffles_within_the_lag_give_the_same_sequence(seed, lag):
    """Each source in its own order, every measurement delayed by at most the lag against the driver."""
    rng = np.random.default_rng(seed)
    streams = {
        source: said(source, *np.sort(rng.integers(1, 200, size=20)).tolist())
        for source in ("loops", "tags", "gps")
    }
    streams[DRIVER] = wheels(*np.unique(rng.integers(1, 200, size=40)).tolist())

    def arriving():
        """By arrival: the driver when it speaks, others up to a lag later, never out of their source's order."""
        arrivals = []
        for source, items in streams.items():
            late = rng.uniform(0, 0 if source == DRIVER else lag, size=len(items))
            times = np.maximum.accumulate(np.array([item.stamp for item in items]) + late)
            times += 1e-6 * (np.arange(len(items)) + rng.random())  # ties between sources fall at random
            arrivals += zip(times, items, strict=True)
        return [item for _, item in sorted(arrivals, key=lambda arrival: arrival[0])]

    first, second = (list(settled(arriving(), DRIVER, lag)) for _ in range(2))
    assert len(first) == sum(map(len, streams.values()))
    assert all(one is other for one, other in zip(first, second, strict=True))
    assert [item.stamp for item in first] == sorted(item.stamp for item in first)


def test_the_watermark_is_told_when_all_that_is_older_has_left():
    told = []
    stream = settled([*wheels(1, 2), *said("loops", 1), *wheels(5)], DRIVER, 1, passed=told.append)
    seen = [(f"{item.source}@{item.stamp}", told[-1] if told else None) for item in stream]
    assert seen == [("loops@1", 1), ("wheels@1", 1), ("wheels@2", 1), ("wheels@5", 4)]
    assert told == [0, 1, 4]
