"""Bytes to measurements, against rosbags' own deserialization of the same bytes: CPU time, medians of several passes."""

from collections.abc import Callable, Sequence
from statistics import median
from time import process_time

import numpy as np

from bench.table import Row
from slam_backend.io.cdr import Decoder
from slam_backend.io.encode import encode_odometry
from slam_backend.io.records import Record
from slam_backend.io.typestore import typestore_of

ODOMETRY = "nav_msgs/msg/Odometry"
MESSAGES, PASSES, MUST = 200_000, 5, ">= 2.5"


def records(count: int) -> list[Record]:
    """Odometry as a robot sends it: one pair of frames, other numbers in every message."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(count, 85))
    return [
        Record(
            "/odom", ODOMETRY, n, encode_odometry(n, "odom", "base_link", a[:7], a[7:43], a[43:49], a[49:])
        )
        for n, a in enumerate(numbers)
    ]


def _seconds(work: Callable[[], None]) -> float:
    begin = process_time()
    work()
    return process_time() - begin


TITLE = "Decoding nav_msgs/Odometry, bytes to Measurement"
EXPLANATION = "Messages per CPU second against rosbags' `deserialize_cdr` of the same bytes; medians of alternating passes."


def rows(count: int = MESSAGES, passes: int = PASSES) -> list[Row]:
    messages: Sequence[Record] = records(count)
    store = typestore_of(())
    decoder = Decoder(store, {"/odom": ("odom", "odometry")})

    def ours() -> None:
        for record in messages:
            decoder.decode(record)

    def theirs() -> None:
        for record in messages:
            store.deserialize_cdr(record.data, ODOMETRY)

    pairs = [(_seconds(ours), _seconds(theirs)) for _ in range(passes)]
    own, rosbags = (median(times) for times in zip(*pairs, strict=True))
    return [
        Row(
            f"{count:,} messages", f"{count / own:,.0f} /s", f"{count / rosbags:,.0f} /s", rosbags / own, MUST
        )
    ]


if __name__ == "__main__":
    for row in rows():
        print(row)
