"""Stamps are exact, frames may carry them, and records never change."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.measurement import (
    SECOND,
    Measurement,
    format_stamp,
    frozen,
    parse_frame,
    parse_stamp,
    seven_of,
    stamp_of,
)


@given(st.integers(0, 2**62))
def test_a_stamp_survives_its_text(stamp):
    assert parse_stamp(format_stamp(stamp)) == stamp


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1700000000.000000001", 1_700_000_000_000_000_001),
        ("3.5", 3_500_000_000),
        ("3", 3 * SECOND),
        ("3.", 3 * SECOND),
    ],
)
def test_fewer_digits_are_padded_on_the_right(text, stamp):
    assert parse_stamp(text) == stamp


@pytest.mark.parametrize(
    "text", ["", ".5", "now", "1.2.3", "1,5", "-1.0", "1e9", "1.0000000001", " 1", "²", "1.²"]
)
def test_what_is_no_stamp_is_refused(text):
    with pytest.raises(ValueError, match=r"."):
        parse_stamp(text)


def test_a_negative_stamp_can_be_told():
    assert format_stamp(-1_500_000_000) == "-1.500000000"


def test_a_frame_may_say_when():
    assert parse_frame("/base@3.25") == ("base", 3_250_000_000)
    assert parse_frame("camera") == ("camera", None)
    assert parse_frame("") == ("", None)
    with pytest.raises(ValueError, match="stamp"):
        parse_frame("base@")


def test_header_stamps_and_poses_are_read_exactly():
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=1)))
    assert stamp_of(message) == 1_700_000_000_000_000_001
    pose = SimpleNamespace(
        position=SimpleNamespace(x=1, y=2, z=3), orientation=SimpleNamespace(x=4, y=5, z=6, w=7)
    )
    np.testing.assert_array_equal(seven_of(pose), [1, 2, 3, 4, 5, 6, 7])


def test_frozen_arrays_are_copies_that_never_change():
    mine = np.ones(3)
    kept = frozen(mine)
    mine[0] = 9
    assert kept[0] == 1
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 2


def test_records_compare_by_identity_and_cannot_be_changed():
    one, other = Measurement(1, "a"), Measurement(1, "a")
    assert one != other
    assert one.ends is None
    with pytest.raises(AttributeError):
        one.stamp = 2
