"""The lines of a graph file, kind by kind, as arrays: one table per format says what its lines hold.

Reading and writing follow the same table, so that they cannot drift apart.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...core.errors import BadFile
from ...core.measurement import Array
from .lines import Ids, Ranks, Rows, Stamps, exact, written_seconds
from .noise import Pairs
from .posegraph import SpaceName

Role = Literal["vertex", "landmark", "edge", "sighting", "range", "prior", "landmark_prior", "fixed"]


class Line(NamedTuple):
    """`<tag> [seconds] <ids> <states> <noise>`: the words of one kind of line, in order."""

    tag: str
    ids: int
    states: int = 0
    noise: Pairs = ()
    stamped: bool = False
    named: bool = False  # ids are PyFG names (A12), else integers

    @property
    def first(self) -> int:
        """Where the ids begin."""
        return 2 if self.stamped else 1

    @property
    def layout(self) -> str:
        parts = (
            ("tag", 1),
            ("time", self.first - 1),
            ("id", self.ids),
            ("state", self.states),
            ("noise", len(self.noise)),
        )
        return " + ".join(f"{count} {word}" for word, count in parts if count)


Table = Mapping[SpaceName, Mapping[Role, Line]]


class Block(NamedTuple):
    """All lines of one kind. ids: one array per end; states (n, k); noise (n, m); stamps (n,) ns."""

    line: Line
    rows: Rows
    ids: tuple[Ids, ...]
    states: Array
    noise: Array
    stamps: Stamps | None

    def bad(self, row: int, what: str) -> BadFile:
        """The error for a line, which is shown up to its ids."""
        return self.rows.bad_line(row, what, words=self.line.first + self.line.ids)


Blocks = dict[Role, Block]


def tags_of(*tables: Table) -> list[str]:
    """Every tag of the tables, once."""
    return list(
        dict.fromkeys(line.tag for table in tables for lines in table.values() for line in lines.values())
    )


def read_blocks(groups: Mapping[str, Rows], table: Table) -> tuple[SpaceName, Blocks]:
    """The blocks that a file has, all of one space. groups: from `lines.by_tag`."""
    planar, spatial = (
        [rows for line in lines.values() if (rows := groups[line.tag]) and _only_in(space, line, table)]
        for space, lines in table.items()
    )
    if planar and spatial:
        rows = min(spatial, key=lambda rows: rows.numbers[0])
        raise rows.bad(
            0, rows.words[0][0], "a line of a 3-D graph in a file that also has lines of a planar one"
        )
    space: SpaceName = "3d" if spatial else "2d"
    return space, {
        role: read_block(line, rows) for role, line in table[space].items() if (rows := groups[line.tag])
    }


def read_block(line: Line, rows: Rows) -> Block:
    start = line.first + line.ids
    end = start + line.states + len(line.noise)
    rows.expect(end, line.layout)
    parse = read_names if line.named else Rows.ids
    numbers = rows.floats(start, end)
    states, noise = numbers[:, : line.states], numbers[:, line.states :]
    if line.states == 7 and (row := first_bad_quaternion(states)) is not None:
        words = " ".join(rows.words[row][start + 3 : start + 7])
        raise rows.bad(row, words, "is no rotation: the quaternion's length is zero or absurd")
    ids = tuple(parse(rows, line.first + k) for k in range(line.ids))
    return Block(line, rows, ids, states, noise, rows.seconds(1) if line.stamped else None)


def write_block(
    path: Path,
    line: Line,
    ids: Sequence[list[str]],
    states: Array,
    noise: Array | None = None,
    stamps: Stamps | None = None,
) -> Iterator[str]:
    """Lines that `read_block` reads back to the same bits. ids: one list of words per end."""
    values = states if noise is None else np.concatenate([states, noise], axis=1)
    if not (finite := np.isfinite(values).all(axis=1)).all():
        where = " ".join([line.tag, *(end[int(finite.argmin())] for end in ids)])
        raise BadFile(f"{path}: {where}: is not finite and cannot be written")
    numbers, times = exact(values), [] if stamps is None else [written_seconds(stamps)]
    for words in zip([line.tag] * len(numbers), *times, *ids, numbers, strict=True):
        yield " ".join(words)


def read_names(rows: Rows, column: int) -> Ids:
    """PyFG's names, a letter and a number, as 64-bit keys with the letter in the top byte."""
    known: dict[str, int] = {}
    keys = []
    for row, words in enumerate(rows.words):
        key = known.get(word := words[column])
        if key is None:
            if (key := key_of(word)) is None:
                raise rows.bad(row, word, "is not a name (one letter and a number, like A12)")
            known[word] = key
        keys.append(key)
    return np.array(keys, dtype=np.uint64)


def key_of(name: str) -> int | None:
    """The key of a PyFG name: letter in the top byte, number below; None if it is none."""
    letter, number = name[:1], name[1:]
    if not (
        name.isascii() and letter.isalpha() and number.isdigit() and len(number) < 18 and int(number) < 2**56
    ):
        return None
    return (ord(letter) << 56) | int(number)


def written_ids(ids: Ids, at: Ranks | None = None) -> list[str]:
    """Ids as words, all of them or those at the given ranks."""
    words = list(map(str, ids.tolist()))
    return words if at is None else [words[rank] for rank in at.tolist()]


def first_bad_quaternion(sevens: Array) -> int | None:
    """The first row whose quaternion cannot be normalized."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(sevens[:, 3:], axis=1)
    bad = ~((length > 1e-6) & (length < 1e6))
    return int(bad.argmax()) if bad.any() else None


def _only_in(space: str, line: Line, table: Table) -> bool:
    return not any(line in lines.values() for other, lines in table.items() if other != space)
