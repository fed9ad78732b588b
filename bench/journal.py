"""What it costs that nothing is lost: the journal beside the replay of the same records, its rate, a restore, a damaged file."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from statistics import median
from time import monotonic, process_time, sleep

import numpy as np

from bench.damage import LOG, NAME, TAIL, content_of, cut, flip, is_whole_commit, lies, read, write
from bench.laps import config, laps
from bench.park import CONFIG as PARK
from bench.table import Row
from slam_backend.core.config import Config, config_from
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import Measurement
from slam_backend.io.bags import open_bag
from slam_backend.io.cdr import Decoder
from slam_backend.io.configfile import load_config
from slam_backend.io.feeder import Feeder
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import Journal
from slam_backend.io.records import Record
from slam_backend.io.replay import Run, replay
from slam_backend.io.schema import insert, open_journal
from slam_backend.io.typestore import typestore_of
from slam_backend.io.worker import Report
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.simulate import Options, simulate

TITLE = "The journal"
EXPLANATION = (
    "Victoria Park: odometry and the sightings of trees, with its own configuration. Warehouse: a simulated drive with loops, and landmarks in every message. Laps: hardly more than bare odometry at 200 Hz, a keyframe every half metre, "
    "a loop every ten seconds; a replay only thins most of it, so that SQLite alone takes more than a twentieth of it, and nothing is promised. Cost: CPU seconds of appending and committing (fsync included) "
    "against the replay of the same journal, decoding and solving included; medians. Beside: CPU seconds of the replay of records in memory while each is journaled in the same process, against the same without; medians of paired "
    "runs; in the live node the two are processes of their own. Index: rows put in by hundreds, with the index of log times that a rosbag2 file has, and without. Rate: wall time until the last record is acknowledged, appended as fast as it goes. Restore: "
    "from the start of the worker to the last row applied, against the time that was recorded. Damage: cut in the last 64 KiB, or one "
    "byte flipped anywhere, closed and as a crash leaves it; an answer is wrong if a record is not as it was written, or one is missing without a word "
    "(cut exactly between two commits, a journal is a shorter journal)."
)
RATE = 200.0  # Hz
MUST = "<= 0.05"
PASSES = 3
HUNDRED = 100  # rows in a commit, where commits are not left to the journal


def rows(minutes: float = 10.0, cuts: int = 2000, flips: int = 500, poses: int = 3000) -> list[Row]:
    records = list(laps(60 * minutes, RATE))
    drive = simulate("warehouse", 2, Options(poses=poses, loop_rate=0.3))
    warehouse = [record for record in drive.records if record.topic != "/truth"]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        seen, rate = _park(place), _rate(records, place / "rate")
        return [
            _cost("Victoria Park", seen, load_config(PARK), place / "park", MUST),
            _beside("Victoria Park", seen, load_config(PARK), place / "beside"),
            _cost("warehouse", warehouse, config_from(drive.settings), place / "warehouse", MUST),
            _cost("laps", records, config(), place / "laps"),
            _indexed(records[: round(100 * RATE)], place),
            _paced(records[: round(10 * RATE)], place / "paced"),
            Row("rate, group commit", f"{rate:,.0f} /s", "", rate, ">= 20000"),
            _restored(place / "laps" / "0", len(records), 60 * minutes),
            *_damaged(place / "damage", cuts, flips),
        ]


def _park(folder: Path) -> list[Record]:
    bag = folder / "park.mcap"
    make_dataset("victoria_park", bag, lambda _: None)
    with open_bag(bag) as opened:
        return list(opened.records())


def _cost(name: str, records: list[Record], chosen: Config, folder: Path, must: str = "") -> Row:
    cost = median(_written(records, folder / f"{n}")[0] for n in range(PASSES))
    replayed = median(_spent(replay(folder / f"{n}" / NAME, chosen)) for n in range(PASSES))
    ours, theirs = (f"{1e6 * seconds / len(records):.1f} us a record" for seconds in (cost, replayed))
    return Row(f"cost, {name}", ours, f"{theirs} to replay", cost / replayed, must)


def _rate(records: list[Record], folder: Path) -> float:
    """Records per second of wall time."""
    return median(len(records) / _written(records, folder / f"{n}")[1] for n in range(PASSES))


class _Drive:
    """Records in memory as the inputs of a run, each of them journaled first, if there is a journal."""

    def __init__(self, records: list[Record], journal: Journal | None) -> None:
        self.paths, self.damage, self.count, self.read = [Path("drive")], list[str](), len(records), 0
        self._records, self._journal = records, journal

    def stream(self, chosen: Config) -> Iterator[Measurement | Decision]:
        decoder = Decoder(typestore_of(()), _table(chosen))
        for record in self._records:
            if self._journal is not None:
                self._journal.append(record.topic, record.type, record.data)
            yield from decoder.decode(record)
        if self._journal is not None:
            self._journal.close()

    def vertex(self, stamp: int) -> int | None:  # noqa: ARG002  # no graph file
        return None

    def close(self) -> None:
        """Nothing is open."""

    def __enter__(self) -> "_Drive":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _beside(name: str, records: list[Record], chosen: Config, folder: Path) -> Row:
    """Alternately, so that a machine that slows down slows both."""
    pairs = [
        tuple(
            _spent(Run(_Drive(records, journal), chosen, []))
            for journal in (None, Journal(folder / f"{n}", print))
        )
        for n in range(PASSES)
    ]
    without, beside = (median(each) for each in zip(*pairs, strict=True))
    extra = median(more / bare for bare, more in pairs) - 1
    return Row(f"beside, {name}", f"{beside:.2f} s with a journal", f"{without:.2f} s without", extra, MUST)


def _indexed(records: list[Record], folder: Path) -> Row:
    bare, indexed = (
        median(_inserted(records, folder / f"{index}{n}.db3", index) for n in range(PASSES))
        for index in (False, True)
    )
    ours, theirs = (f"{1e6 * seconds / len(records):.1f} us a record" for seconds in (indexed, bare))
    return Row("index", ours, f"{theirs} without", indexed / bare)


def _inserted(records: list[Record], path: Path, index: bool) -> float:
    entries = [(n, r.topic, r.type, r.log_time, r.data) for n, r in enumerate(records, 1)]
    begin, topics = process_time(), dict[tuple[str, str], int]()
    with closing(open_journal(path)) as database:
        if not index:
            database.execute("DROP INDEX timestamp_idx")
        for k in range(0, len(entries), HUNDRED):
            with database:
                topics = insert(database, topics, entries[k : k + HUNDRED], {})
    return process_time() - begin


def _written(records: list[Record], folder: Path) -> tuple[float, float]:
    """CPU and wall seconds; the queue is bounded, so what comes too fast waits."""
    journal = Journal(folder, print)
    cpu, begin = process_time(), monotonic()
    for n, record in enumerate(records):
        journal.append(record.topic, record.type, record.data)
        if n % 10_000 == 9_999:
            journal.wait(n - 20_000, 60)
    journal.wait(len(records) - 1, 60)
    seconds = monotonic() - begin
    journal.close()
    assert journal.committed == len(records)
    return process_time() - cpu, seconds


def _paced(records: list[Record], folder: Path) -> Row:
    """As a robot sends them: a commit, with its fsync, for each ten."""
    journal = Journal(folder, print)
    cpu, begin = process_time(), monotonic()
    for n, record in enumerate(records):
        sleep(max(begin + n / RATE - monotonic(), 0))
        journal.append(record.topic, record.type, record.data)
    journal.close()
    share = (process_time() - cpu) / (monotonic() - begin)
    return Row(f"CPU at {RATE:.0f} Hz, as they come", f"{share:.2%} of one core", "", share)


def _spent(run: Run) -> float:
    """CPU seconds of a run to its end."""
    begin = process_time()
    for _ in run:
        pass
    return process_time() - begin


def _table(chosen: Config) -> dict[str, tuple[str, str]]:
    return dict(OWN) | {source.topic: (name, source.kind) for name, source in chosen.sources.items()}


def _restored(folder: Path, count: int, recorded: float) -> Row:
    """Wall seconds of the whole way: process, journal, pipe, solver."""
    journal, chosen = Journal(folder, print), config()
    applied: list[int] = []

    def told(report: Report) -> None:
        applied.append(report.applied)

    begin = monotonic()
    feeder = Feeder(journal, chosen, _table(chosen), told, print)
    feeder.request("snapshot", timeout=3600)
    seconds = monotonic() - begin
    assert applied[-1] >= count
    feeder.close()
    journal.close()
    return Row("restore, laps", f"{seconds:.1f} s", f"{recorded:.0f} s recorded", recorded / seconds, ">= 20")


def _damaged(folder: Path, cuts: int, flips: int) -> list[Row]:
    rng, wrong, silent = np.random.default_rng(0), {"cut": 0, "flip": 0}, 0
    begin = monotonic()
    for n, (state, count) in enumerate(
        (("closed", 600), ("crashed", 600), ("crashed, after checkpoints", 2400))
    ):
        home = folder / state
        home.mkdir(parents=True)
        whole = write(home, count, closed=n == 0)
        content = content_of(home)
        name = LOG if n and len(content[LOG]) else NAME
        size = len(content[name])
        for at in rng.integers(max(size - TAIL, 0), size, -(-cuts // 3)):
            found, damage = read(cut(content, name, int(at), home / "copy"))
            if lies(found, damage, whole):
                bare = name == LOG and is_whole_commit(found, whole)
                silent, wrong["cut"] = silent + bare, wrong["cut"] + (not bare)
        for _ in range(-(-flips // 3)):
            found, damage = read(flip(content, rng, home / "copy"))
            wrong["flip"] += bool(lies(found, damage, whole))
    seconds = monotonic() - begin
    return [
        Row(
            f"wrong answers after {cuts:,} cuts",
            f"{seconds:.0f} s with the flips",
            f"{silent} between commits",
            wrong["cut"],
            "<= 0",
        ),
        Row(f"wrong answers after {flips:,} flips", "", "", wrong["flip"], "<= 0"),
    ]


if __name__ == "__main__":
    for row in rows(float(os.environ.get("MINUTES", "10"))):
        print(row)
