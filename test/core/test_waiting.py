"""What waits is bounded, and each measurement has a number of its own among those with its stamp."""

from collections import Counter

import numpy as np
import pytest

from slam_backend.core import waiting as module
from slam_backend.core.config import Config, LandmarkSource, OdometrySource, RelativeSource
from slam_backend.core.errors import BadConfig
from slam_backend.core.graph import Offer, Wait
from slam_backend.core.measurement import Measurement, format_stamp
from slam_backend.core.waiting import Waiting


@pytest.fixture
def waiting() -> Waiting:
    sources = {"wheels": OdometrySource(), "tags": LandmarkSource(), "loops": RelativeSource()}
    return Waiting(Config(sources=sources))


def offered(waiting: Waiting, source: str, stamp: int) -> Offer:
    waiting.offer(Measurement(stamp, source))
    return waiting._pending[-1]


def test_numbers_count_those_with_the_same_stamp_whatever_the_order(waiting) -> None:
    rng = np.random.default_rng(1)
    seen: Counter[tuple[str, int]] = Counter()
    for stamp in rng.integers(1, 200, 2000).tolist():
        source = ("tags", "loops")[int(rng.integers(2))]
        assert offered(waiting, source, stamp).id == f"{source}/{format_stamp(stamp)}/{seen[source, stamp]}"
        seen[source, stamp] += 1


def test_ids_that_are_taken_are_not_given_again_in_whatever_order_they_are_told(waiting) -> None:
    waiting.remember(["tags/0.000000005/2", "tags/0.000000005/0", "tags/0.000000003/0"])
    assert [offered(waiting, "tags", stamp).id[-1] for stamp in (5, 3, 4, 5)] == ["3", "1", "0", "4"]


def test_a_source_that_nobody_knows_is_a_mistake_of_the_configuration(waiting) -> None:
    with pytest.raises(BadConfig, match="there is no source 'radar'; known: wheels, tags, loops"):
        waiting.offer(Measurement(1, "radar"))


def test_of_what_waits_in_vain_the_older_half_is_dropped_and_no_other_source_suffers(
    waiting, monkeypatch
) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 100)
    decisions = []
    for stamp in range(10):
        decisions += waiting.wait(Wait(Offer(f"loops/{stamp}", Measurement(stamp, "loops")), 7, "no end"))
    for stamp in range(1000):
        offer = Offer(f"tags/{stamp}", Measurement(stamp, "tags"))
        decisions += waiting.wait(Wait(offer, stamp % 3, "one bearing"))
    assert [d.reason for d in decisions if d.verdict == "probation"] == ["undetermined"] * 1010
    floods = [d for d in decisions if d.verdict == "refused"]
    assert {(d.source, d.reason) for d in floods} == {("tags", "flood")}
    left = waiting.leftovers()
    kept = [d.stamp for d in left if d.source == "tags"]
    assert sum(d.count for d in floods) + len(kept) == 1000
    assert len(kept) <= 150
    assert sorted(kept) == list(range(1000 - len(kept), 1000))
    assert [d.stamp for d in left if d.source == "loops"] == list(range(10))


def test_what_waited_for_a_variable_is_offered_again_when_it_is_there(waiting) -> None:
    offer = Offer("tags/0.000000005/0", Measurement(5, "tags"))
    waiting.wait(Wait(offer, 3, "one bearing"))
    waiting.wake(2)
    assert not waiting
    waiting.wake(3)
    assert waiting.window(5) == [offer]


def test_numbers_are_remembered_of_the_newest_stamps_and_are_never_given_twice(waiting, monkeypatch) -> None:
    monkeypatch.setattr(module, "REMEMBERED", 100)
    rng = np.random.default_rng(2)
    ids = []
    for newest in range(1, 3000):
        late = newest - int(rng.integers(0, 5)) * int(rng.integers(0, 200))
        ids += [offered(waiting, "tags", max(stamp, 1)).id for stamp in (newest, late)]
    assert len(set(ids)) == len(ids)
    assert len(waiting._tallies["tags"]._stamps) <= 101
