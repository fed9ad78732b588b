"""A record is a plain, frozen value."""

from dataclasses import FrozenInstanceError

import pytest

from slam_backend.io.records import Record


def test_a_record_cannot_be_changed() -> None:
    """What was journaled is what is decoded, wherever the record has been in between."""
    record = Record("/odom", "nav_msgs/msg/Odometry", 5, b"\0\1\0\0")
    with pytest.raises(FrozenInstanceError):
        record.log_time = 6  # type: ignore[misc]


def test_records_are_told_apart_by_identity() -> None:
    """Two equal messages are two messages: comparing bytes would make a duplicate vanish."""
    one, other = (Record("/a", "std_msgs/msg/Empty", 1, b"") for _ in range(2))
    assert one != other
    assert len({one, other}) == 2
