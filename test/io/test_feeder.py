"""The feeder: a worker that may be slow, stopped or killed, and ends where replay ends."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from slam_backend.core.command import TOPIC, TYPE, command, text_of
from slam_backend.core.errors import SlamError
from slam_backend.core.query import Unknown
from slam_backend.core.trajectory import Snapshot
from slam_backend.io.bags import open_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.encode import encode_string
from slam_backend.io.feeder import Feeder
from slam_backend.io.finished import FinishedRun
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import Journal
from slam_backend.io.replay import replay
from slam_backend.lab.simulate import Options, simulate, write_simulation

POSES = 300
PACKAGE = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}  # for scripts that lie elsewhere


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A short drive: its configuration, its records, the summary of its replay, the keyframe of each update there."""
    folder = tmp_path_factory.mktemp("drive")
    options = Options(poses=POSES, loop_rate=0.3, landmarks=30, duplicated=0.02)
    written = write_simulation(simulate("square", 3, options), folder / "drive.mcap")
    config = load_config(written.config)
    with open_bag(written.bag) as bag:
        records = [record for record in bag.records() if record.topic != "/truth"]
    run = replay(written.bag, config)
    updates = [update.keyframe.index for update in run]
    return config, records, run.result.summary, updates


class Stage:
    """A journal and its feeder, and all that they say."""

    def __init__(self, folder: Path, config):
        self.folder, self.config = folder, config
        self.reports, self.deaths = [], []
        self.journal = Journal(folder, self.deaths.append)
        table = dict(OWN) | {source.topic: (name, source.kind) for name, source in config.sources.items()}
        self.feeder = Feeder(self.journal, config, table, self.reports.append, self.deaths.append)

    def append(self, records):
        for record in records:
            self.journal.append(record.topic, record.type, record.data)

    def until(self, condition, seconds=20.0):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"it did not happen in time; told: {self.deaths}"
            time.sleep(0.01)

    def has_read(self, rows):
        return lambda: self.journal.committed >= rows and self.feeder._worker.applied >= rows

    def finish(self):
        self.journal.close()
        return self.feeder.finish(str(self.folder / "run"), 30)

    @property
    def updates(self):
        return [update.keyframe.index for report in self.reports for update in report.updates]

    @property
    def decisions(self):
        return [decision for report in self.reports for decision in report.decisions]


@pytest.fixture
def stage(tmp_path, drive):
    stage = Stage(tmp_path, drive[0])
    yield stage
    stage.journal.close()
    pid = stage.feeder.pid
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
    stage.feeder.close()
    assert not Path(f"/proc/{pid}").exists()
    names = {thread.name for thread in threading.enumerate()}
    assert not names & {"feeder", "rows", "journal"}


def test_what_is_fed_comes_out_as_replay_has_it(stage, drive) -> None:
    """The hash, every update once, every decision once; the run is in its folder."""
    _, records, summary, updates = drive
    stage.append(records)
    told = stage.finish()
    assert (
        told["run_hash"]
        == summary["run_hash"]
        == replay(stage.journal.path, stage.config).result.summary["run_hash"]
    )
    assert (stage.folder / "run" / "summary.json").exists()
    assert stage.updates == updates
    assert stage.reports[-1].applied == stage.journal.committed
    assert sum(d.count for d in stage.decisions) >= sum(summary["decisions"].values())
    assert not stage.deaths


def test_a_killed_worker_is_replaced_and_nothing_is_told_twice(stage, drive) -> None:
    """Killed three times: once idle, once with rows under way, once just before the end."""
    _, records, summary, updates = drive
    stage.append(records[:200])
    stage.until(stage.has_read(200))
    first = stage.feeder.pid
    os.kill(first, signal.SIGKILL)
    stage.until(lambda: stage.feeder.restarts == 1 and stage.feeder.pid != first)
    stage.append(records[200:400])
    time.sleep(0.3)
    os.kill(stage.feeder.pid, signal.SIGKILL)
    stage.until(lambda: stage.feeder.restarts == 2)
    stage.append(records[400:])
    stage.until(stage.has_read(len(records)))
    os.kill(stage.feeder.pid, signal.SIGKILL)
    assert stage.finish()["run_hash"] == summary["run_hash"]
    assert stage.updates == updates
    assert sum(d.count for d in stage.decisions) >= sum(summary["decisions"].values())
    assert [line.split("(")[1].split(")")[0] for line in stage.deaths] == ["it ended with code -9"] * 3


def test_a_command_is_part_of_what_a_new_worker_reads(stage, drive) -> None:
    """Carried out in the midst of the drive, and again by the successor of a killed worker: one hash, that of the replay."""
    _, records, summary, _ = drive
    half = len(records) // 2
    stage.append(records[:half])
    stage.journal.append(TOPIC, TYPE, encode_string(text_of(command("17", "optimize", {}))))
    stage.until(lambda: any(decision.id == "command/17" for decision in stage.decisions))
    stage.append(records[half : half + 20])
    stage.journal.append(TOPIC, TYPE, encode_string(text_of(command("18", "edit", {"disable": ["loops"]}))))
    stage.append(records[half + 20 : half + 40])
    stage.journal.append(TOPIC, TYPE, encode_string(text_of(command("19", "undo", {}))))
    stage.append(records[half + 40 : -50])
    stage.until(stage.has_read(len(records) - 47))
    os.kill(stage.feeder.pid, signal.SIGKILL)
    stage.append(records[-50:])
    told = stage.finish()
    assert told["run_hash"] == replay(stage.journal.path, stage.config).result.summary["run_hash"]
    assert told["run_hash"] != summary["run_hash"]
    assert told["decisions"]["command/optimize"] == told["decisions"]["command/undo"] == 1
    disabled, undone = (
        {each.id for each in stage.decisions if each.reason == why} for why in ("disabled", "undone")
    )
    assert disabled == undone != set()
    assert FinishedRun(stage.folder / "run").again().result.summary["run_hash"] == told["run_hash"]
    assert [decision.id for decision in stage.decisions].count("command/17") == 1


def test_a_stopped_worker_holds_nobody_up(stage, drive) -> None:
    """Rows go to the journal, a request gives up in time; afterwards all is made up for."""
    _, records, summary, _ = drive
    stage.append(records[:100])
    stage.until(stage.has_read(100))
    os.kill(stage.feeder.pid, signal.SIGSTOP)
    for _ in range(3):  # more than a pipe holds
        stage.append(records[100:400])
    begin = time.monotonic()
    with pytest.raises(SlamError, match=r"did not answer 'snapshot': not within 0\.3 s"):
        stage.feeder.request("snapshot", timeout=0.3)
    assert time.monotonic() - begin < 1
    stage.until(lambda: stage.feeder.backlog >= 900)
    os.kill(stage.feeder.pid, signal.SIGCONT)
    stage.append(records[400:])
    assert isinstance(stage.feeder.request("snapshot"), Snapshot)
    stage.until(lambda: stage.feeder.backlog == 0)
    assert stage.finish()["counts"]["keyframes"] == summary["counts"]["keyframes"]
    assert not stage.deaths


def test_a_stopped_worker_can_be_closed(stage, drive) -> None:
    """At once, though rows wait in the pipe."""
    stage.append(drive[1])
    stage.until(lambda: stage.feeder._worker.applied > 0)
    os.kill(stage.feeder.pid, signal.SIGSTOP)
    stage.append(drive[1])
    time.sleep(0.2)
    begin = time.monotonic()
    stage.feeder.close()
    assert time.monotonic() - begin < 0.5
    with pytest.raises(SlamError, match="it has been ended"):
        stage.feeder.request("snapshot")


def test_a_stopped_worker_bounds_the_farewell(stage, drive) -> None:
    stage.append(drive[1])
    os.kill(stage.feeder.pid, signal.SIGSTOP)
    stage.journal.close()
    begin = time.monotonic()
    with pytest.raises(SlamError, match="'finish'"):
        stage.feeder.finish(str(stage.folder / "run"), 0.5)
    assert time.monotonic() - begin < 2


def test_a_worker_that_computes_gets_on_and_one_that_is_stopped_does_not(stage, drive) -> None:
    """To write a large map takes long, and no row is read meanwhile: the farewell waits as long as this goes on."""
    stage.append(drive[1])
    stage.until(stage.has_read(len(drive[1])))
    read = stage.feeder._worker.progress
    for n in range(5):
        stage.feeder.request("save", str(stage.folder / f"save{n}"))
    saved = stage.feeder._worker.progress
    assert saved[0] == read[0]
    assert saved[1] != read[1]
    os.kill(stage.feeder.pid, signal.SIGSTOP)
    time.sleep(0.1)
    stopped = stage.feeder._worker.progress
    time.sleep(0.3)
    assert stage.feeder._worker.progress == stopped


def test_paused_it_keeps_records_and_answers(stage, drive) -> None:
    _, records, summary, _ = drive
    stage.append(records[:200])
    stage.until(stage.has_read(200))
    stage.feeder.pause(True)
    stage.append(records[200:])
    stage.until(lambda: stage.journal.committed == len(records))
    time.sleep(0.3)
    assert stage.feeder.backlog == len(records) - 200
    before = stage.feeder.request("snapshot")
    assert len(before.stamps) < POSES
    stage.feeder.pause(False)
    stage.until(lambda: stage.feeder.backlog == 0)
    stage.feeder.pause(True)  # and the end does not wait for anybody to go on
    assert stage.finish()["run_hash"] == summary["run_hash"]


def test_a_run_that_is_saved_while_its_inputs_come_can_be_made_again_and_edited(stage, drive) -> None:
    """Whatever has come since: its journal is read as far as it was then, and nothing is settled that still waited."""
    records, folder = drive[1], stage.folder / "early"
    stage.append(records[:350])
    stage.until(stage.has_read(350))
    told = stage.feeder.request("save", str(folder))
    stage.append(records[350:])
    assert stage.finish()["ended"] == "input"
    saved = FinishedRun(folder)
    assert (told["ended"], told["counts"]["records"]) == ("saved", 350)
    again = saved.again()
    assert again.result.summary["run_hash"] == told["run_hash"]
    saved.compare(again)
    loop = next(d for d in again.decisions if d.ends is not None and d.verdict == "accepted")
    for _ in again.edit(command("after the end 1", "edit", {"disable": [loop.id]})):
        pass
    assert again.result.summary["counts"]["factors"] == told["counts"]["factors"] - 1
    with pytest.raises(Unknown, match="the input ends at"):
        saved.past(again.reached + 10**9)


def test_paused_a_dead_worker_gets_a_successor_that_knows_as_much(stage, drive) -> None:
    """And no more, until it goes on."""
    _, records, summary, _ = drive
    stage.append(records[:200])
    stage.until(stage.has_read(200))
    stage.feeder.pause(True)
    stage.append(records[200:])
    stage.until(lambda: stage.journal.committed == len(records))
    before = len(stage.feeder.request("snapshot").stamps)
    os.kill(stage.feeder.pid, signal.SIGKILL)
    stage.until(lambda: stage.feeder.restarts == 1)
    assert len(stage.feeder.request("snapshot").stamps) == before
    assert stage.feeder.backlog == len(records) - 200
    stage.feeder.pause(False)
    assert stage.finish()["run_hash"] == summary["run_hash"]


def test_after_a_death_answers_are_not_older_than_before(stage, drive) -> None:
    """A request waits until the new worker knows what the old one knew."""
    stage.append(drive[1])
    stage.until(stage.has_read(len(drive[1])))
    before = len(stage.feeder.request("snapshot").stamps)
    os.kill(stage.feeder.pid, signal.SIGKILL)
    stage.until(lambda: stage.feeder.restarts == 1)
    assert len(stage.feeder.request("snapshot").stamps) >= before > POSES - 10


def test_a_request_dies_with_its_worker(stage, drive) -> None:
    """It is not left waiting, and the next one is answered by the next worker."""
    stage.append(drive[1])
    stage.until(stage.has_read(len(drive[1])))
    os.kill(stage.feeder.pid, signal.SIGSTOP)
    failures = []

    def ask():
        try:
            stage.feeder.request("snapshot", timeout=20)
        except SlamError as error:
            failures.append(str(error))

    asking = threading.Thread(target=ask)
    asking.start()
    stage.until(lambda: stage.feeder._worker.asked)
    os.kill(stage.feeder.pid, signal.SIGKILL)
    asking.join(10)
    assert failures == ["the worker ended before it answered"]
    assert isinstance(stage.feeder.request("snapshot"), Snapshot)


def test_a_request_that_cannot_be_met_says_why(stage, drive) -> None:
    stage.append(drive[1][:50])
    stage.until(stage.has_read(50))
    (stage.folder / "file").write_text("")
    with pytest.raises(SlamError, match="file"):
        stage.feeder.request("save", str(stage.folder / "file"))
    with pytest.raises(SlamError):
        stage.feeder.request("covariance", "99999")
    assert stage.feeder.restarts == 0


def test_a_run_without_a_message_ends_in_words(stage) -> None:
    with pytest.raises(SlamError, match="not one usable message"):
        stage.finish()


def test_a_worker_that_dies_again_and_again_is_not_started_in_a_hurry(stage, drive, capfd) -> None:
    """A defect that the journal holds would otherwise take a core for ever; each death is said with its reason."""
    stage.journal.close()
    stage.feeder.close()
    broken = Feeder(stage.journal, None, {}, stage.reports.append, stage.deaths.append)
    stage.until(lambda: broken.restarts == 1)
    time.sleep(3)
    assert broken.restarts <= 5
    stage.until(lambda: broken.restarts >= 2)
    broken.close()
    assert all("AttributeError" in line and "\n" not in line for line in stage.deaths)
    assert "Traceback" not in capfd.readouterr().err


def test_signals_do_not_reach_a_worker_that_is_starting(tmp_path, drive) -> None:
    """Ctrl-C goes to the whole group: the node decides when the worker ends, and nobody prints a traceback."""
    config = tmp_path / "config.yaml"
    config.write_text("sources: [wheels]\nwheels: {kind: odometry, topic: /odom}\n")
    code = f"""
import os, signal, time
from pathlib import Path
from slam_backend import load_config
from slam_backend.io.feeder import Feeder
from slam_backend.io.journal import Journal
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    journal = Journal(Path({str(tmp_path)!r}), print)
    feeder = Feeder(journal, load_config({str(config)!r}), {{"/odom": ("wheels", "odometry")}}, lambda _: None, print)
    for n in range(100):
        os.killpg(0, signal.SIGINT)
        os.killpg(0, signal.SIGTERM)
        time.sleep(0.02)
    print(len(feeder.request("snapshot", timeout=20).stamps), feeder.restarts)
    feeder.close()
"""
    script = tmp_path / "script.py"
    script.write_text(code)
    ended = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True, text=True, timeout=60, start_new_session=True, check=False, env=PACKAGE,
    )  # fmt: skip
    assert (ended.stdout, ended.stderr) == ("0 0\n", "")


def test_nobody_is_left_when_the_node_is_killed(tmp_path, drive) -> None:
    """SIGKILL, with rows under way."""
    code = """
import sys, time
from pathlib import Path
from slam_backend import Config
from slam_backend.core.config import OdometrySource
from slam_backend.io.feeder import Feeder
from slam_backend.io.journal import Journal
if __name__ == "__main__":
    journal = Journal(Path(sys.argv[1]), print)
    feeder = Feeder(journal, Config(sources={"wheels": OdometrySource(topic="/odom")}),
                    {"/odom": ("wheels", "odometry")}, lambda _: None, print)
    feeder.request("snapshot", timeout=20)
    print(feeder.pid, flush=True)
    time.sleep(60)
"""
    script = tmp_path / "script.py"
    script.write_text(code)
    command = [sys.executable, str(script), str(tmp_path)]
    node = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=PACKAGE)
    worker = int(node.stdout.readline())
    node.kill()
    node.wait()
    node.stdout.close()
    end = time.monotonic() + 10
    while Path(f"/proc/{worker}").exists():
        assert time.monotonic() < end, "the worker is still there"
        time.sleep(0.05)
