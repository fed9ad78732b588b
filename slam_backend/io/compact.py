"""Journals made as small as they can be, and nothing of them lost."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from ..core.errors import BadFile
from .events import TOPIC
from .journal import NAME
from .restore import claim, examine
from .schema import connect, sync

SET_ASIDE = "journal-*.db3"


def compact(place: Path) -> Iterator[str]:
    """A journal, or all of a folder; one line for each. What was set aside and holds nothing that was heard is removed.

    BadFile if a node is writing there, or a journal is damaged: that is left as it is.
    """
    folder = place if place.is_dir() else place.parent
    paths = [folder / NAME, *sorted(folder.glob(SET_ASIDE))] if place.is_dir() else [place]
    if not any(path.exists() for path in paths):
        raise BadFile(f"{place}: there is no journal")
    with claim(folder):
        for path in paths:
            if path.exists():
                yield _compacted(path)


def _compacted(path: Path) -> str:
    found = examine(path)
    if found.damage:
        raise BadFile(f"{'; '.join(found.damage)}; it is left as it is: export what is whole")
    before = path.stat().st_size
    if path.name != NAME and not set(found.topics) - {TOPIC}:
        path.unlink()
        return f"{path}: nothing was heard in that session: removed"
    fresh = path.with_name("compacted.db3")
    fresh.unlink(missing_ok=True)
    try:
        with closing(connect(path, "rw")) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.execute("VACUUM INTO ?", (str(fresh),))
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            raise sqlite3.OperationalError("somebody else has it open")
        copied = examine(fresh)
        if (copied.topics, copied.span, copied.damage) != (found.topics, found.span, []):
            raise sqlite3.DatabaseError("the copy is not the same")
        sync(fresh)
        fresh.replace(path)
        sync(path.parent)
    except (sqlite3.Error, OSError) as error:
        fresh.unlink(missing_ok=True)
        raise BadFile(f"{path}: cannot be written anew: {error}; it is left as it is") from None
    return f"{path}: {found.records} records, {before / 1e6:.1f} -> {path.stat().st_size / 1e6:.1f} MB"
