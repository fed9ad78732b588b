"""A journal, cut and bent; shared by the tests and the benchmark."""

import shutil
from pathlib import Path

import numpy as np

from slam_backend.core.config import Journaling
from slam_backend.core.errors import BadFile
from slam_backend.io.bags import open_bag
from slam_backend.io.encode import encode_odometry
from slam_backend.io.journal import NAME, Journal

LOG = f"{NAME}-wal"
TAIL = 1 << 16  # bytes at the end that are cut
ODOMETRY = "nav_msgs/msg/Odometry"
Told = tuple[str, int, bytes]  # topic, log time, data


def write(folder: Path, count: int, closed: bool) -> list[Told]:
    """A journal of `count` records in commits of ten; not closed: as a crash leaves it, most of it in the log."""
    journal = Journal(folder / "live", print, Journaling(commit_delay=0.001))
    zeros = np.zeros(36)
    for n in range(count):
        twist = encode_odometry(n + 1, "odom", "base", (n, 0, 0, 0, 0, 0, 1), zeros, zeros[:6], zeros)
        journal.append("/loops" if n % 7 == 3 else "/odom", ODOMETRY, twist)
        if n % 10 == 9:
            journal.wait(n, 10)
    journal.wait(count - 1, 10)
    if closed:
        journal.close()
    for name in (NAME, LOG):
        if (folder / "live" / name).exists():
            shutil.copy(folder / "live" / name, folder / name)
    journal.close()
    return read(folder / NAME)[0]


def read(path: Path) -> tuple[list[Told], list[str]]:
    """What can be read, and what is said about it."""
    try:
        with open_bag(path) as bag:
            found = [(record.topic, record.log_time, bytes(record.data)) for record in bag.records()]
            return found, bag.damage
    except BadFile as error:
        return [], str(error).splitlines()


def cut(content: dict[str, bytes], name: str, at: int, folder: Path) -> Path:
    """The journal with one of its files cut after `at` bytes."""
    return _laid_out({**content, name: content[name][:at]}, folder)


def flip(content: dict[str, bytes], rng: np.random.Generator, folder: Path) -> Path:
    """The journal with one byte changed, anywhere in its files."""
    names = sorted(content)
    sizes = np.array([len(content[name]) for name in names])
    name = names[rng.choice(len(names), p=sizes / sizes.sum())]
    bent = bytearray(content[name])
    bent[rng.integers(len(bent))] ^= rng.integers(1, 256)
    return _laid_out({**content, name: bytes(bent)}, folder)


def ends(content: dict[str, bytes], whole: list[Told]) -> np.ndarray:
    """Where in the database each record ends."""
    return np.array([content[NAME].find(data) + len(data) for _, _, data in whole])


def content_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in (NAME, LOG) if (folder / name).exists()}


def _laid_out(content: dict[str, bytes], folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, raw in content.items():
        (folder / name).write_bytes(raw)
    return folder / NAME


def lies(found: list[Told], damage: list[str], whole: list[Told]) -> str:
    """What is wrong with an answer about a damaged journal; empty: nothing."""
    if found == whole:
        return ""
    rest = iter(whole)
    if not all(record in rest for record in found):
        return "records that were not written, or not in this order"
    return "" if damage else "records are missing, and nothing is said"


def is_whole_commit(found: list[Told], whole: list[Told]) -> bool:
    """Cut between two commits, or with all of its log gone, a journal is a shorter journal: nobody can tell."""
    return found == whole[: len(found)] and (len(found) % 10 == 0)
