"""MAT-files: numbers come back as they were written, and damage is said."""

import zlib
from pathlib import Path
from struct import pack

import numpy as np
import pytest

from slam_backend.core.errors import BadFile
from slam_backend.lab.matlab import read_arrays

CLASSES = {"f8": (6, 9), "i4": (12, 5)}  # dtype -> class of the array, type of its numbers


def element(kind: int, data: bytes) -> bytes:
    if len(data) <= 4:
        return pack("<HH", kind, len(data)) + data.ljust(4, b"\0")
    return pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(name: str, values: np.ndarray) -> bytes:
    array_class, kind = CLASSES[values.dtype.str[1:]]
    parts = (
        element(6, pack("<II", array_class, 0)),
        element(5, np.array(values.shape, dtype="<i4").tobytes()),
        element(1, name.encode()),
        element(kind, values.tobytes(order="F")),
    )
    return element(14, b"".join(parts))


def squeezed(data: bytes) -> bytes:
    packed = zlib.compress(data)
    return pack("<II", 15, len(packed)) + packed


def write_mat(path: Path, compress: bool = False, **arrays: np.ndarray) -> Path:
    pieces = [matrix(name, array) for name, array in arrays.items()]
    path.write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124)
        + b"\x00\x01IM"
        + b"".join(map(squeezed, pieces) if compress else pieces)
    )
    return path


@pytest.mark.parametrize("compress", [False, True])
def test_arrays_come_back_by_name_in_their_shape(tmp_path: Path, compress: bool) -> None:
    """Doubles and integers, long and short names, plain and compressed."""
    table, times = np.arange(6.0).reshape(2, 3), np.array([[7], [8], [9]], dtype=np.int32)
    found = read_arrays(write_mat(tmp_path / "x.mat", compress, table=table, t=times))
    np.testing.assert_array_equal(found["table"], table)
    np.testing.assert_array_equal(found["t"], times)


@pytest.mark.parametrize("compress", [False, True])
def test_a_damaged_file_is_one_line_that_names_it(tmp_path: Path, compress: bool) -> None:
    """One that is not there, and every way to cut a good one short."""
    with pytest.raises(BadFile, match=r"none\.mat: No such file"):
        read_arrays(tmp_path / "none.mat")
    whole = write_mat(tmp_path / "x.mat", compress, table=np.eye(3)).read_bytes()
    for length in range(129, len(whole)):
        (tmp_path / "cut.mat").write_bytes(whole[:length])
        told = ""
        try:
            found = read_arrays(tmp_path / "cut.mat")
        except BadFile as error:
            found, told = {}, str(error)
        assert "table" not in found
        assert not told or "cut.mat" in told
