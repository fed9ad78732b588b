"""Numeric arrays of a MATLAB 5 file, as far as data sets need them (MathWorks, MAT-File Format, 2023, "Level 5")."""

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..core.errors import BadFile
from ..core.measurement import Array

HEAD = 128  # bytes of text and version before the first element
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}


def read_arrays(path: Path) -> Mapping[str, Array]:
    """Name -> array, of the real numeric ones. BadFile if it cannot be read, or is no such file."""
    try:
        return dict(_arrays(path.read_bytes()[HEAD:]))
    except OSError as error:
        raise BadFile(f"{path}: {error.strerror}") from None
    except (ValueError, struct.error, zlib.error) as error:
        raise BadFile(f"{path}: not a MATLAB 5 file, or damaged ({error})") from None


def _arrays(data: bytes) -> Iterator[tuple[str, Array]]:
    for kind, body in _elements(data):
        inner = zlib.decompress(body) if kind == COMPRESSED else b""
        content = next(_elements(inner), (0, b""))[1] if inner else body
        _, (_, size), (_, name), (form, numbers), *_ = _elements(content)
        if form in NUMBERS:
            shape = np.frombuffer(size, dtype="<i4")
            array = np.frombuffer(numbers, dtype=NUMBERS[form]).astype(np.float64)
            yield name.decode(), array.reshape(shape, order="F")


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and bytes of each; small ones keep their bytes in the tag. All but compressed ones end at multiples of eight."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:
            yield kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]
            at += 8
        else:
            yield kind, data[at + 8 : at + 8 + size]
            at += 8 + size + (0 if kind == COMPRESSED else -size % 8)
