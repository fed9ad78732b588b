"""What the page of a run costs, beside the replay that it tells of."""

from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

from bench.table import Row
from slam_backend.io.history import NAME, History
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.report import REPORT, write_report
from slam_backend.lab.report.subject import Subject

TITLE = "The page of a run"
EXPLANATION = "`report.html` of city10000: 10,000 keyframes. Baseline: its replay, CPU. Watching: what is noted of each update for the page."


def rows() -> list[Row]:
    with TemporaryDirectory() as folder:
        bag, out = Path(folder) / "bag.mcap", Path(folder) / "run"
        make_dataset("city10000", bag)
        run = replay(bag)
        history, watched, begin = History(run), 0.0, process_time()
        for update in run:
            before = process_time()
            history.see(update)
            watched += process_time() - before
        replayed = process_time() - begin - watched
        write_run(run.result, out)
        history.write(out / NAME)
        begin = process_time()
        write_report(Subject(out), out / REPORT)
        built, size = process_time() - begin, (out / REPORT).stat().st_size / 1e6
        keyframes = len(run.result.trajectory)
    whole = built + watched
    return [
        Row(f"building it, {keyframes:,} keyframes", f"{built:.1f} s", "", built, "<= 10"),
        Row(
            "watching and building, of the replay",
            f"{whole:.1f} s",
            f"{replayed:.1f} s",
            whole / replayed,
            "<= 0.25",
        ),
        Row("its size", f"{size:.1f} MB", "", size, "<= 8"),
    ]
