"""PointCloud2 as columns: every layout that is legal is read, every other is one clear line."""

import array
from types import SimpleNamespace

import numpy as np
import pytest

from slam_backend.core.errors import BadMessage
from slam_backend.core.sensors.cloud import columns, scalars


def field(name, offset, datatype=7, count=1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(fields, data=b"", width=0, step=4, height=1, bigendian=False) -> SimpleNamespace:
    return SimpleNamespace(
        fields=fields, data=data, width=width, height=height, point_step=step, is_bigendian=bigendian
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_of_every_type_lie_anywhere_in_the_point(order):
    layout = np.dtype(
        {
            "names": ["a", "b", "c", "d", "e", "f", "g", "h"],
            "formats": [order + t for t in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")],
            "offsets": [3, 2, 4, 8, 12, 16, 20, 25],
            "itemsize": 40,
        }
    )
    table = np.zeros(6, dtype=layout)
    for name in layout.names:
        table[name] = np.arange(6)
    fields = [field(name, layout.fields[name][1], n + 1) for n, name in enumerate(layout.names)]
    read = columns(cloud(fields, table.tobytes(), 3, 40, height=2, bigendian=order == ">"))
    assert list(read) == list(layout.names)
    for column in read.values():
        np.testing.assert_array_equal(column, np.arange(6))


def test_vectors_are_rows_and_a_count_of_zero_means_one():
    read = columns(cloud([field("v", 0, 8, 3), field("x", 24, 8, 0)], np.arange(8.0).tobytes(), 2, 32))
    np.testing.assert_array_equal(read["v"], [[0, 1, 2], [4, 5, 6]])
    np.testing.assert_array_equal(read["x"], [3, 7])
    np.testing.assert_array_equal(scalars(read, ["x", "x"]), [[3, 3], [7, 7]])
    with pytest.raises(BadMessage, match="'v' holds 3"):
        scalars(read, ["x", "v"])


@pytest.mark.parametrize(
    "kind",
    [bytes, bytearray, memoryview, lambda b: array.array("B", b), lambda b: np.frombuffer(b, np.uint8)],
)
def test_data_may_be_any_buffer_and_longer_than_needed(kind):
    data = np.array([1.5, 2.5, 99.0], dtype=np.float32).tobytes()
    np.testing.assert_array_equal(columns(cloud([field("x", 0)], kind(data), 2))["x"], [1.5, 2.5])


def test_a_cloud_without_points_or_fields_is_empty():
    assert columns(cloud([field("x", 0)]))["x"].shape == (0,)
    assert columns(cloud([], step=0)) == {}
    assert columns(cloud([], b"", 5, 0)) == {}


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        (cloud([field("x", 0)], b"\0" * 4, 2), "holds 4 bytes where 2 points"),
        (cloud([field("x", 0)], b"\0" * 4, 2**31, height=2**31), "are announced"),
        (cloud([field("x", 0, 9)], b"\0" * 4, 1), "datatype 9"),
        (cloud([field("x", 1)], b"\0" * 4, 1), "beyond the point step"),
        (cloud([field("x", 0, 7, 2**31)], b"\0" * 4, 1), "beyond the point step"),
        (cloud([field("x", 0)], b"", 5, 0), "beyond the point step"),
        (cloud([field("x", 0), field("x", 0)], b"\0" * 4, 1), "twice"),
        (cloud([field("x", 0)], b"", 0, 2**40), "cannot be"),
    ],
)
def test_a_layout_that_cannot_be_is_one_clear_line(bad, text):
    with pytest.raises(BadMessage, match=text):
        columns(bad)
