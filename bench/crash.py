"""Killed at random moments of a run, again and again: what was acknowledged is there, and the run ends as if nothing had happened."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic

import numpy as np

from bench.laps import config, laps
from bench.table import Row
from slam_backend.io.feeder import Feeder
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import NAME, Journal
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.io.restore import examine
from slam_backend.io.worker import Report

TITLE = "kill -9"
EXPLANATION = (
    "A process with journal, feeder and worker, as the node has them, is fed a drive and killed at a random moment: the process, its worker, or both. It is started "
    "again on the same folder and fed on from the first record that is not in the journal. `lost`: records that were said to be acknowledged and are not there. "
    "At the end of each drive the run hash is compared with that of a replay of the drive."
)
KINDS = ("node", "worker", "both")
MINUTES, RATE = 4.0, 50.0


def rows(kills: int = 200, each: int = 10) -> list[Row]:
    """each: kills in one drive."""
    records = list(laps(60 * MINUTES, RATE))
    expected = _hash_of(records)
    rng, lost, different, worst = np.random.default_rng(0), 0, 0, 0
    begin = monotonic()
    for drive in range(-(-kills // each)):
        with tempfile.TemporaryDirectory() as folder:
            home = Path(folder)
            for _ in range(min(each, kills - drive * each)):
                missing, pending = _killed(home, KINDS[rng.integers(3)], rng.uniform(0.02, 1.0))
                lost, worst = lost + missing, max(worst, pending)
            different += _finished(home) != expected
    note = f"{monotonic() - begin:.0f} s; at most {worst} records were not acknowledged yet"
    return [
        Row(f"acknowledged records lost in {kills} kills", note, "", lost, "<= 0"),
        Row("runs that end with another hash", f"of {-(-kills // each)}", "", different, "<= 0"),
    ]


def _hash_of(records: Sequence[Record]) -> str:
    from slam_backend.io.writing import write_bag

    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "drive.mcap", records)
        return str(replay(Path(folder) / "drive.mcap", config()).result.summary["run_hash"])


def _start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "bench.crash", str(folder), *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def _killed(folder: Path, kind: str, seconds: float) -> tuple[int, int]:
    """Records lost that had been acknowledged; records that had been appended and not yet acknowledged."""
    process = _start(folder)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    told, end = [0, 0], monotonic() + seconds
    for line in process.stdout:
        told = [int(word) for word in line.split()]
        if monotonic() > end:
            break
    if kind != "node":
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)
    if kind == "worker":  # the process goes on with another one for a while
        for line in process.stdout:
            told = [int(word) for word in line.split()]
            if monotonic() > end + seconds:
                break
    process.kill()
    rest = process.stdout.read().splitlines()  # what it had said before it died
    process.wait()
    acknowledged, appended = (
        [int(word) for word in rest[-1].split()] if rest and len(rest[-1].split()) == 2 else told
    )
    there = examine(folder / NAME)
    assert not there.damage
    return max(acknowledged - there.records, 0), max(appended - there.records, 0)


def _finished(folder: Path) -> str:
    process = _start(folder, "finish")
    output, _ = process.communicate(timeout=300)
    return output.split()[-1]


def live(folder: Path, finish: bool) -> None:
    """What is killed: goes on from the journal, says what is acknowledged and what is appended; a thousand records a second."""
    records = list(laps(60 * MINUTES, RATE))
    journal, chosen = Journal(folder, print), config()
    table = dict(OWN) | {source.topic: (name, source.kind) for name, source in chosen.sources.items()}

    def told(_: Report) -> None:
        """Nobody listens."""

    feeder = Feeder(journal, chosen, table, told, lambda line: sys.stderr.write(f"{line}\n"))
    print(feeder.pid, flush=True)
    for n, record in enumerate(records[journal.committed :], start=journal.committed + 1):
        journal.append(record.topic, record.type, record.data)
        if n % 20 == 0 and not finish:
            journal.wait(1 << 62, 0.02)
            print(journal.committed, n, flush=True)
    if finish:
        journal.close()
        print(feeder.finish(str(folder / "run"), 240)["run_hash"])
    else:
        while True:
            print(journal.committed, len(records), flush=True)
            journal.wait(1 << 62, 0.1)


if __name__ == "__main__":
    live(Path(sys.argv[1]), len(sys.argv) > 2)
