"""While there is no session, memory is bounded, and a flood drowns neither the driving source nor what is rare."""

from collections import Counter

import numpy as np

from slam_backend.ros.backlog import Backlog


def heard(topic: str, n: int, size: int = 10) -> tuple[str, str, bytes]:
    return topic, "type", n.to_bytes(4, "big") + bytes(size - 4)


def left(backlog: Backlog) -> list[tuple[str, int]]:
    return [(topic, int.from_bytes(data[:4], "big")) for topic, _, data in backlog.clear()]


def test_messages_leave_in_the_order_in_which_they_came() -> None:
    backlog = Backlog(100, 10_000)
    came = [("/odom", 0), ("/scan", 1), ("/odom", 2), ("/tags", 3)]
    for each in came:
        backlog.append(heard(*each))
    assert backlog.popleft() == heard("/odom", 0)
    backlog.put_back([heard("/odom", 0)])
    assert left(backlog) == came
    assert not backlog
    assert not backlog.dropped


def test_of_a_flood_the_oldest_are_dropped_and_counted_and_nothing_else() -> None:
    backlog = Backlog(100, 1 << 20)
    backlog.protected = "/odom"
    for n in range(60):
        backlog.append(heard("/odom", n))
    backlog.append(heard("/tags", 0))
    for n in range(500):
        backlog.append(heard("/scan", n))
    assert backlog.dropped == Counter({"/scan": 461})
    assert left(backlog) == [
        *(("/odom", n) for n in range(60)), ("/tags", 0), *(("/scan", n) for n in range(461, 500)),
    ]  # fmt: skip


def test_bytes_are_bounded_as_well_as_numbers() -> None:
    backlog = Backlog(1_000_000, 10_000)
    backlog.protected = "/odom"
    for n in range(50):
        backlog.append(heard("/odom", n, 100))
        backlog.append(heard("/scan", n, 2_000))
    assert backlog.dropped == Counter({"/scan": 48})
    assert [n for topic, n in left(backlog) if topic == "/odom"] == list(range(50))


def test_the_protected_topic_loses_its_oldest_when_nothing_else_is_left() -> None:
    backlog = Backlog(10, 1 << 20)
    backlog.protected = "/odom"
    for n in range(15):
        backlog.append(heard("/odom", n))
    assert left(backlog) == [("/odom", n) for n in range(5, 15)]


def test_what_came_is_there_or_counted_whatever_the_sizes() -> None:
    rng = np.random.default_rng(3)
    backlog, came = Backlog(40, 5_000), Counter()
    for n in range(2_000):
        topic = f"/{rng.integers(5)}"
        came[topic] += 1
        backlog.append(heard(topic, n, int(rng.integers(4, 6_000 if n % 50 == 0 else 300))))
        if n % 7 == 0 and backlog:
            backlog.put_back([backlog.popleft()])
        assert backlog._count <= 40
        assert backlog._size <= 5_000
    dropped = Counter(backlog.dropped)
    assert dropped + Counter(topic for topic, _ in left(backlog)) == came
