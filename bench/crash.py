"""Killed at random moments of a run, again and again: what was acknowledged is there, and the run ends as if nothing had happened."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic, sleep

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
MINUTES, RATE = 8.0, 50.0
LONGEST = 3.0  # s from a start to its kill: enough for the worker to be at work
PATIENCE = 3600.0  # s that the end of a drive may take beside other load


def rows(kills: int = 200, each: int = 10) -> list[Row]:
    """each: kills in one drive."""
    records = list(laps(60 * MINUTES, RATE))
    expected = _hash_of(records)
    rng, lost, different, worst, busy = np.random.default_rng(0), 0, 0, 0, 0
    begin = monotonic()
    for drive in range(-(-kills // each)):
        with tempfile.TemporaryDirectory() as folder:
            home = Path(folder)
            for _ in range(min(each, kills - drive * each)):
                missing, pending, solved = _killed(home, KINDS[rng.integers(3)], rng.uniform(0.02, LONGEST))
                lost, worst, busy = lost + missing, max(worst, pending), busy + solved
            different += _finished(home) != expected
        done = min(each * (drive + 1), kills)
        print(f"{done} of {kills} kills: {lost} records lost, {different} other hashes", file=sys.stderr)
    note = f"{busy} of them while it solved; at most {worst} records were not acknowledged yet; {monotonic() - begin:.0f} s"
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


def _killed(folder: Path, kind: str, seconds: float) -> tuple[int, int, bool]:
    """Records lost that had been acknowledged; records that had been appended and not yet acknowledged; whether it had begun to solve."""
    process = _start(folder)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    sleep(seconds)
    if kind != "node":
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)
    if kind == "worker":
        sleep(seconds)  # the process goes on with another one for a while
    process.kill()
    lines = process.stdout.read().splitlines(keepends=True)
    process.wait()
    told = [
        line.split() for line in lines if line.endswith("\n")
    ]  # it may have been killed in the midst of one
    acknowledged, appended, applied = map(int, told[-1]) if told else (0, 0, 0)
    there = examine(folder / NAME)
    assert not there.damage
    return max(acknowledged - there.records, 0), max(appended - there.records, 0), applied > 0


def _finished(folder: Path) -> str:
    process = _start(folder, "finish")
    output, _ = process.communicate(timeout=PATIENCE)
    return output.split()[-1]


def live(folder: Path, finish: bool) -> None:
    """What is killed: goes on from the journal, says what is acknowledged, appended and applied; a thousand records a second."""
    records = list(laps(60 * MINUTES, RATE))
    journal, chosen = Journal(folder, print), config()
    table = dict(OWN) | {source.topic: (name, source.kind) for name, source in chosen.sources.items()}

    applied = 0

    def told(report: Report) -> None:
        nonlocal applied
        applied = report.applied

    feeder = Feeder(journal, chosen, table, told, lambda _: None)
    print(feeder.pid, flush=True)
    for n, record in enumerate(records[journal.committed :], start=journal.committed + 1):
        journal.append(record.topic, record.type, record.data)
        if n % 20 == 0 and not finish:
            journal.wait(1 << 62, 0.02)
            print(journal.committed, n, applied, flush=True)
    if finish:
        journal.close()
        print(feeder.finish(str(folder / "run"), PATIENCE)["run_hash"])
    else:
        while True:
            print(journal.committed, len(records), applied, flush=True)
            journal.wait(1 << 62, 0.1)


if __name__ == "__main__":
    live(Path(sys.argv[1]), len(sys.argv) > 2)
