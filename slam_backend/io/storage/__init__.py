"""One file per storage format; this table is the list of them."""

from collections.abc import Callable
from contextlib import ExitStack
from typing import NamedTuple

from . import mcap, rosbag1, sqlite
from .parts import Contents, Source


class Storage(NamedTuple):
    """magic: how its files begin. open: raises BadFile if nothing can be read."""

    magic: bytes
    open: Callable[[Source, ExitStack], Contents]


STORAGES = (
    Storage(rosbag1.MAGIC, lambda source, _: rosbag1.open_rosbag1(source)),
    Storage(mcap.MAGIC, lambda source, _: mcap.open_mcap(source)),
    Storage(sqlite.MAGIC, sqlite.open_sqlite),
)


def open_storage(source: Source, stack: ExitStack) -> Contents:
    """Open a file as what its first bytes say it is. BadFile if that is none of these, or it cannot be read."""
    begin = source.read(0, 16)
    for storage in STORAGES:
        if begin.startswith(storage.magic):
            return storage.open(source, stack)
    what = "the file is empty" if source.size == 0 else "neither a rosbag1, an mcap nor a sqlite3 file"
    raise source.bad(f"{what}; name a .bag, .mcap or .db3 file, or a rosbag2 folder")
