"""What a folder holds of a session that was not ended, and what it takes to go on with it."""

import fcntl
import json
import sqlite3
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import IO, Literal

from ..core.config import Config, config_from, config_to
from ..core.errors import BadConfig, BadFile
from . import events
from .bags import open_bag
from .events import Event
from .journal import NAME
from .schema import connect, insert, open_journal
from .storage.wal import torn

RUN = "run"  # the folder, beside the journal, of the run that is saved at the end
RUNS = "runs"  # the folder, beside the journal, of those that are saved on the way
SUMMARY = "summary.json"
LOCK = "journal.lock"
ENDINGS = ("", "-wal", "-shm")
BESIDE_THE_RESULT = ("data_dir", "autostart", "path", "journal")  # settings that change no trajectory
CHUNK = 1000  # records that are copied at a time


@dataclass(frozen=True)
class Examination:
    """A journal, read to its end. topics: name -> records; span: log times (ns) of the first and the last one, or None.

    damage: what is missing or wrong. torn: what a crash left unfinished at its end, which is no damage.
    """

    path: Path
    topics: Counter[str]
    span: tuple[int, int] | None
    events: Sequence[tuple[int, Event]]  # with their log times
    damage: Sequence[str]
    torn: str

    @property
    def records(self) -> int:
        return self.topics.total()

    @property
    def config(self) -> Config | None:
        """That it was solved with last; None if it does not say, or says it in words of another version."""
        for _, event in reversed(self.events):
            if event["event"] == "config":
                with suppress(BadConfig):
                    return config_from(event["config"], str(self.path))
        return None

    def is_solved_alike(self, config: Config) -> bool:
        """Whether a configuration makes the same trajectory of it, as far as is known."""
        before = self.config
        return before is None or _decisive(before) == _decisive(config)


def _decisive(config: Config) -> dict[str, object]:
    return {name: value for name, value in config_to(config).items() if name not in BESIDE_THE_RESULT}


def examine(path: Path, advance: Callable[[int], None] = lambda _: None) -> Examination:
    """Read every record, with a call of `advance(n)` for each n. BadFile if nothing of it can be read."""
    left = torn(path.with_name(f"{path.name}-wal"))
    topics: Counter[str] = Counter()
    first, last = None, 0
    said: list[tuple[int, Event]] = []
    with open_bag(path) as bag:
        for record in bag.records():
            topics[record.topic] += 1
            advance(1)
            first, last = first or record.log_time, record.log_time
            if events.is_own(record):
                with suppress(ValueError):
                    said.append((record.log_time, events.event_of(record.data)))
        harmless = {f"{path}: {left}", f"{path}: holds no messages"}
        damage = [line for line in bag.damage if line not in harmless]
    span = (first, last) if first is not None else None
    return Examination(path, topics, span, said, damage, left)


def claim(folder: Path) -> IO[str]:
    """The folder is this process's alone until the file is closed, or the process ends in any way. BadFile if it is another's."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("w")
    except OSError as error:
        raise BadFile(f"{folder / NAME}: cannot be used as journal: {error}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise BadFile(
            f"{folder}: in use: another process writes its journal there; a node has its data_dir for itself"
        ) from None
    return lock


def unfinished(folder: Path, resume: Literal["unfinished", "always", "never"]) -> Examination | None:
    """The journal to go on with, if there is one. BadFile if there may be one, and it cannot be read."""
    path = folder / NAME
    if resume == "never" or not path.exists():
        return None
    if resume == "unfinished" and _ended(path):
        return None
    found = examine(path)
    if found.damage and not found.records:
        raise BadFile("; ".join(found.damage))
    return found if found.records else None


def _ended(path: Path) -> bool:
    """Whether the last thing that a journal says is its end; of one that says nothing, whether its run was saved."""
    try:
        with closing(connect(path, "ro")) as database:
            last = database.execute(
                "SELECT t.name, m.data FROM messages m JOIN topics t ON t.id = m.topic_id ORDER BY m.id DESC LIMIT 1"
            ).fetchone()
            says = database.execute("SELECT 1 FROM topics WHERE name = ?", (events.TOPIC,)).fetchone()
            if says is None:
                return (path.parent / RUN).exists()
            return last is not None and last[0] == events.TOPIC and events.event_of(last[1])["event"] == "end"
    except (sqlite3.Error, ValueError):
        return False  # reading it will tell why


def set_aside(folder: Path, names: Sequence[str] = (NAME, RUN)) -> int:
    """What an earlier session left keeps its place in the folder, under the next free number. BadFile if that cannot be."""
    n = next(k for k in count(1) if not any((folder / _numbered(name, k)).exists() for name in (NAME, RUN)))
    for name in names:
        for ending in ENDINGS:
            old, new = folder / f"{name}{ending}", folder / f"{_numbered(name, n)}{ending}"
            try:
                if old.exists():
                    old.rename(new)
            except OSError as error:
                raise BadFile(f"{old}: cannot be set aside: {error.strerror}") from None
    if RUN in names:
        _follow(folder, n)
    return n


def _follow(folder: Path, n: int) -> None:
    """The runs of a session, also those saved on the way, say from now on where its journal is: queries and edits replay it."""
    old, new = (folder / NAME).resolve(), folder / _numbered(NAME, n)
    for path in (folder / _numbered(RUN, n) / SUMMARY, *folder.glob(f"{RUNS}/*/{SUMMARY}")):
        with suppress(OSError, ValueError, LookupError, TypeError):  # a run that is damaged stays as it is
            told = json.loads(path.read_text(encoding="utf-8"))
            if [Path(name).resolve() for name in told["input"]] == [old]:
                told["input"] = [str(new.absolute())]
                fresh = folder / f"{new.name}.json"
                fresh.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
                fresh.replace(path)


def _numbered(name: str, n: int) -> str:
    stem, dot, ending = name.partition(".")
    return f"{stem}-{n}{dot}{ending}"


def salvage(found: Examination) -> str:
    """Carry the whole records of a damaged journal over to a new one, which confesses the gap. What was done, in words.

    The damaged file is set aside. BadFile if there is no room for the new one.
    """
    fresh = found.path.with_name("salvaged.db3")
    try:
        for ending in ENDINGS:
            fresh.with_name(f"{fresh.name}{ending}").unlink(missing_ok=True)
        with closing(open_journal(fresh)) as database, database:
            _copy(found, database)
    except (OSError, sqlite3.Error) as error:
        raise BadFile(f"{found.path}: is damaged, and cannot be written anew: {error}") from None
    n = set_aside(found.path.parent, (NAME,))
    fresh.rename(found.path)
    return f"{'; '.join(found.damage)}; {found.records} whole records go on, the damaged file is {_numbered(NAME, n)}"


def _copy(found: Examination, database: sqlite3.Connection) -> None:
    with open_bag(found.path) as bag:
        entries = ((n, r.topic, r.type, r.log_time, r.data) for n, r in enumerate(bag.records(), start=1))
        topics: dict[tuple[str, str], int] = {}
        while chunk := list(islice(entries, CHUNK)):
            topics = insert(database, topics, chunk, {})
    first, last = found.span or (0, 0)
    gap = events.encoded(events.gap(first, last + 1, 0, "; ".join(found.damage)))
    insert(database, topics, [(found.records + 1, events.TOPIC, events.TYPE, last + 1, gap)], {})
