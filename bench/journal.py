"""What it costs that nothing is lost: the journal beside the replay of the same records, its rate, a restore, a damaged file."""

import os
import tempfile
from pathlib import Path
from statistics import median
from time import monotonic, process_time, sleep

import numpy as np

from bench.damage import LOG, NAME, TAIL, content_of, cut, flip, is_whole_commit, lies, read, write
from bench.laps import config, laps
from bench.table import Row
from slam_backend.core.config import Config, config_from
from slam_backend.io.feeder import Feeder
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import Journal
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.io.worker import Report
from slam_backend.lab.simulate import Options, simulate

TITLE = "The journal"
EXPLANATION = (
    "Laps: a planar robot, odometry at 200 Hz, a keyframe every half metre, a loop every ten seconds. Warehouse: a keyframe, and landmarks, in every message. Cost: CPU seconds of appending and committing (fsync included) "
    "against the replay of the same journal, decoding and solving included; medians; in the live node the two are processes of their own. Rate: wall time until the last record is acknowledged, appended as fast as it goes. Restore: "
    "from the start of the worker to the last row applied, against the time that was recorded. Damage: cut in the last 64 KiB, or one "
    "byte flipped anywhere, closed and as a crash leaves it; an answer is wrong if a record is not as it was written, or one is missing without a word "
    "(cut exactly between two commits, a journal is a shorter journal)."
)
RATE = 200.0  # Hz
MUST = {"warehouse": "<= 0.05"}  # bare odometry costs its replay hardly more than its way to the disk
PASSES = 3


def rows(minutes: float = 10.0, cuts: int = 2000, flips: int = 500, poses: int = 3000) -> list[Row]:
    records, drive = (
        list(laps(60 * minutes, RATE)),
        simulate("warehouse", 2, Options(poses=poses, loop_rate=0.3)),
    )
    warehouse = [record for record in drive.records if record.topic != "/truth"]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        row, rate = _cost("laps", records, config(), place / "laps")
        restored = _restored(place / "laps" / "0", len(records))
        return [
            _cost("warehouse", warehouse, config_from(drive.settings), place / "warehouse")[0],
            row,
            _paced(records[: round(10 * RATE)], place / "paced"),
            Row("rate, group commit", f"{rate:,.0f} /s", "", rate, ">= 20000"),
            Row(
                "restore, laps",
                f"{restored:.1f} s",
                f"{60 * minutes:.0f} s recorded",
                60 * minutes / restored,
                ">= 20",
            ),
            *_damaged(place / "damage", cuts, flips),
        ]


def _cost(name: str, records: list[Record], chosen: Config, folder: Path) -> tuple[Row, float]:
    """And records per second of wall time."""
    written = [_written(records, folder / f"{n}") for n in range(PASSES)]
    cost, wall = (median(times) for times in zip(*written, strict=True))
    replayed = median(_replayed(folder / f"{n}" / NAME, chosen) for n in range(PASSES))
    ours, theirs = (f"{1e6 * seconds / len(records):.1f} us a record" for seconds in (cost, replayed))
    return Row(f"cost, {name}", ours, f"{theirs} to replay", cost / replayed, MUST.get(name, "")), len(
        records
    ) / wall


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


def _replayed(path: Path, chosen: Config) -> float:
    begin = process_time()
    run = replay(path, chosen)
    for _ in run:
        pass
    return process_time() - begin


def _restored(folder: Path, count: int) -> float:
    """Wall seconds of the whole way: process, journal, pipe, solver."""
    journal = Journal(folder, print)
    chosen = config()
    table = dict(OWN) | {source.topic: (name, source.kind) for name, source in chosen.sources.items()}
    applied: list[int] = []

    def told(report: Report) -> None:
        applied.append(report.applied)

    begin = monotonic()
    feeder = Feeder(journal, chosen, table, told, print)
    feeder.request("snapshot", timeout=3600)
    seconds = monotonic() - begin
    assert applied[-1] >= count
    feeder.close()
    journal.close()
    return seconds


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
