"""Where the write-ahead log of a SQLite database stops being whole (https://sqlite.org/fileformat2.html, section 4).

SQLite uses the log up to its last whole commit and says nothing about what comes after it: the commit that a crash
interrupted, or rows that were there and cannot be read any more.
"""

from functools import cache
from pathlib import Path
from struct import Struct

import numpy as np
from numpy.typing import NDArray

_HEADER, _FRAME = Struct(">8I"), Struct(">6I")
_MAGIC = {0x377F0682: "<u4", 0x377F0683: ">u4"}  # -> words that the checksums are made of

Words = NDArray[np.uint32]


def torn(log: Path) -> str:
    """What is wrong with the end of a log, in words; empty: nothing, or there is no log. OSError if it cannot be read."""
    if not log.is_file() or not (size := log.stat().st_size):
        return ""
    raw = log.read_bytes()
    page = _page_of(raw)
    if page is None:
        return f"none of the {size} bytes of its write-ahead log can be used: the log's header is damaged"
    whole = _whole(raw, page)
    lost = sum(_belongs(raw, at) for at in range(whole, size, _FRAME.size + page))
    return (
        f"the write-ahead log is cut at its last whole commit: {lost} of its pages after that are unfinished or damaged"
        if lost
        else ""
    )


def _page_of(raw: bytes) -> int | None:
    """The size of a page, if the header is whole."""
    if len(raw) < _HEADER.size:
        return None
    magic, _, page, *_, sum0, sum1 = _HEADER.unpack_from(raw)
    if magic not in _MAGIC or not 512 <= page <= 65536 or page & (page - 1):
        return None
    words = np.frombuffer(raw, _MAGIC[magic], 6)
    return page if _sums((0, 0), words) == (sum0, sum1) else None


def _whole(raw: bytes, page: int) -> int:
    """Bytes up to the end of the last whole commit."""
    magic, *_, sum0, sum1 = _HEADER.unpack_from(raw)
    sums, whole = (sum0, sum1), _HEADER.size
    step = _FRAME.size + page
    for at in range(_HEADER.size, len(raw) - step + 1, step):
        _, commit, *_, sum0, sum1 = _FRAME.unpack_from(raw, at)
        content = raw[at : at + 8] + raw[at + _FRAME.size : at + step]
        sums = _sums(sums, np.frombuffer(content, _MAGIC[magic]))
        if sums != (sum0, sum1) or raw[at + 8 : at + 16] != raw[16:24]:
            break
        if commit:
            whole = at + step
    return whole


def _belongs(raw: bytes, at: int) -> bool:
    """Whether a frame is of the log's newest round, with the salts of its header: those of earlier rounds have other salts. One of the two may be damaged."""
    salts = raw[at + 8 : at + 16]
    return len(salts) < 8 or salts[:4] == raw[16:20] or salts[4:] == raw[20:24]


def _sums(start: tuple[int, int], words: Words) -> tuple[int, int]:
    """SQLite's checksum of an even number of words: s0 += x + s1; s1 += y + s0; modulo 2^32.

    That is linear, s' = M s + B (x, y), so that the sums of many words are products with powers of M.
    """
    n = len(words) // 2
    of_start, of_words = _powers(n)
    pairs = words.astype(np.uint32).reshape(n, 2)
    s = of_start @ np.array(start, np.uint32) + np.einsum("nij,nj->i", of_words, pairs, dtype=np.uint32)
    return int(s[0]), int(s[1])


@cache
def _powers(n: int) -> tuple[Words, Words]:
    """M^n, and M^(n-1-i) B for each pair i."""
    M, B = np.array([[1, 1], [1, 2]], np.uint32), np.array([[1, 0], [1, 1]], np.uint32)
    power, found = np.eye(2, dtype=np.uint32), np.empty((n, 2, 2), np.uint32)
    for i in reversed(range(n)):
        found[i] = power @ B
        power = power @ M
    return power, found
