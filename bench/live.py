"""The node over real DDS, between processes: what is lost, how long everything takes, and whether live is replay."""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import count, takewhile
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import slam_backend as sb
from bench.park import CONFIG as PARK
from bench.process import Backend, Process, Processes, cpu_seconds, free_domains, own_network, stopped
from bench.table import Row
from slam_backend.core.measurement import SECOND, Array
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.inputs import TF_STATIC
from slam_backend.lab.datasets import make_dataset
from slam_backend.lab.options import Options
from slam_backend.lab.simulate import simulate, write_simulation

LOAD = Path(__file__).parent / "load.py"
LOOPBACK = {
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).parent / "loopback.xml"),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",  # the only one that leaves the transports to the profile
}
STARTS = 7
SETTLED = 2.0  # s after which a process no longer announces itself ten times a second
SOURCES = (
    "space=2d",
    "sources=[wheels,loops]",
    "wheels={kind: odometry, topic: /odom}",
    "loops={kind: relative, topic: /loops}",
)
ODOMETRY, PATH = "nav_msgs/msg/Odometry", "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
RATE, CUT = 5, 300  # times the recorded speed; seconds of each recording that are played
HALF = 5000  # keyframes

TITLE = "Live"
EXPLANATION = (
    "The node, its worker, and senders, listeners and clients in processes of their own, over DDS on one machine, by UDP "
    "(with Fast DDS's shared memory each process that appears stops all publishers for a third of a second: its issue 6535); all times by "
    "the clock on the wall, so they need a machine that does nothing else. `lost`: messages sent, less those in the journal. Latency of "
    "`~/odometry`: from before it is published to its receipt, 99th percentile. Client: Python, its own decoding included. "
    "Start: Fast DDS announces a participant before it hears; where the answer comes at once, it is lost, and repeated after 3 s. "
    f"Equal hashes: of three live runs at {RATE} times the speed, all at once, of the first {CUT} s of a recording, each with the "
    "replay of its journal, and with that of the bag where no record is missing."
)


def rows() -> list[Row]:
    if find_spec("rclpy") is None:
        print("live: rclpy is not installed; left out")
        return []
    own_network()
    os.environ |= LOOPBACK
    return [*loaded(), *stalled(), *large(), *started(), *equal()]


@contextmanager
def running(*settings: str, seconds: float = 200) -> Iterator[tuple[Backend, Processes]]:
    with TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        yield (
            Backend(processes, Path(folder) / "data", settings=[*SOURCES, *settings], seconds=seconds),
            processes,
        )


class Sender:
    """Drives on a circle. sent: messages by topic."""

    def __init__(self, processes: Processes, radius: float) -> None:
        self.process = processes.start(LOAD, "send", radius, seconds=200)
        self.process.wait_for("matched")
        self.sent = {"/odom": 0, "/loops": 0}
        self._lines = count(1)  # of its output

    def begin(self, hz: float, speed: float, seconds: float, loops: float = 0) -> None:
        self.process.tell(f"{hz} {speed} {seconds} {loops}")

    def end(self, seconds: float = 100) -> None:
        _, odometry, _, loops, *_ = self.process.wait_for("sent ", seconds, next(self._lines)).split()
        self.sent["/odom"] += int(odometry)
        self.sent["/loops"] += int(loops)

    def drive(self, hz: float, speed: float, seconds: float, loops: float = 0) -> None:
        self.begin(hz, speed, seconds, loops)
        self.end(seconds + 60)

    def lost(self, node: Backend) -> int:
        journal = node.rows()
        return sum(sent - journal.get(topic, 0) for topic, sent in self.sent.items())


class Listener:
    """Hears ~/odometry."""

    def __init__(self, processes: Processes) -> None:
        self._process = processes.start(LOAD, "hear", "/slam_backend/odometry", ODOMETRY, seconds=300)
        self._process.wait_for("ready")
        self._heard: Array | None = None

    def during(self, act: Callable[[], object]) -> tuple[int, int]:
        """When it began and ended, in ns."""
        begin = time.time_ns()
        act()
        return begin, time.time_ns()

    def tail(self, phase: tuple[int, int]) -> float:
        """99th percentile of the latency in this phase, ms. Hears no more."""
        if self._heard is None:
            self._process.end()
            self._heard = np.array(json.loads(self._process.output.splitlines()[-1]))
        stamps, latencies = self._heard.T
        return float(np.percentile(latencies[(phase[0] <= stamps) & (stamps < phase[1])], 99))


# -- what is lost ------------------------------------------------------------------------------------


def loaded() -> list[Row]:
    """1,000 odometry messages and 20 loops a second for a minute."""
    hz, loops, seconds = 1000, 20, 60
    with running() as (node, processes):
        Listener(processes)
        sender = Sender(processes, 5)
        before = node.process.cpu_seconds
        sender.drive(hz, 10, seconds, loops)
        used = (node.process.cpu_seconds - before) / seconds
        summary = node.end(seconds=60)
        lost, journaled = sender.lost(node), sum(node.rows().values())
    what = f"{hz} Hz odometry, {loops} loops/s, {seconds} s"
    return [
        Row(f"{what}: lost", f"{lost}", f"{sum(sender.sent.values())} sent", lost, "<= 0"),
        Row(f"{what}: node's CPU", f"{used:.2f} cores", "1 core", used, "<= 1"),
        Row(f"{what}: not applied", f"{summary['counts']['records']} applied", f"{journaled} journaled", journaled - summary["counts"]["records"], "<= 0"),
    ]  # fmt: skip


def stalled() -> list[Row]:
    """The worker stands still for five seconds."""
    with running() as (node, processes):
        sender = Sender(processes, 5)
        sender.begin(200, 10, 10, 5)
        time.sleep(2)
        stopped(node.worker, 5)()
        sender.end()
        summary = node.end(seconds=60)
        lost = sum(sender.sent.values()) - summary["counts"]["records"]
    return [Row("worker stopped for 5 s at 200 Hz: lost", f"{lost}", f"{sum(sender.sent.values())} sent", lost, "<= 0")]  # fmt: skip


# -- how long it takes -------------------------------------------------------------------------------


def large() -> list[Row]:
    """A map of 5,000 keyframes, then of as many again."""
    step, radius = 0.6, HALF * 0.6 / (2 * np.pi)
    with running("path.poses=10000") as (node, processes):
        watch = processes.start(LOAD, "watch", seconds=300)
        sender, listener = Sender(processes, radius), Listener(processes)
        sender.drive(1000, 1000 * step, HALF / 1000)
        catch_up(watch)
        idle = listener.during(lambda: sender.drive(200, 1, 6))
        worker = cpu_seconds(node.worker())
        loops = listener.during(lambda: sender.drive(200, 1, 6, loops=4))
        busy = (cpu_seconds(node.worker()) - worker) / 6
        catch_up(watch)
        sender.drive(1000, 1000 * step, HALF / 1000)
        catch_up(watch)
        sender.begin(200, 1, 10)
        plans: list[Any] = []
        answering = listener.during(lambda: plans.extend(asked(processes, "get_trajectory", 7)))
        sender.end()
        queries = asked(processes, "query", 3)
        share = path_share(node, processes, sender)
        drawn = draws(processes)
        node.end(seconds=100)
        tails = [listener.tail(phase) for phase in (idle, loops, answering)]
        lost = sender.lost(node)
    sizes, seconds = zip(*plans, strict=True)
    return [
        Row("messages that made and used the map: lost", f"{lost}", f"{sum(sender.sent.values())} sent", lost, "<= 0"),
        Row("~/odometry at 200 Hz, worker idle: latency", f"{tails[0]:.1f} ms", "", tails[0], "<= 10"),
        Row(f"- while it closes loops of {HALF} poses (busy {busy:.0%})", f"{tails[1]:.1f} ms", "", tails[1], "<= 10"),
        Row("- over the idle value", f"{tails[1]:.1f} ms", f"{tails[0]:.1f} ms", tails[1] / tails[0], "<= 3"),
        Row(f"- while ~/get_trajectory of {max(sizes)} poses is answered", f"{tails[2]:.1f} ms", "", tails[2], "<= 10"),
        Row("- over the idle value", f"{tails[2]:.1f} ms", f"{tails[0]:.1f} ms", tails[2] / tails[0], "<= 3"),
        Row(f"~/path of {2 * HALF} poses: build and publish", f"{np.median(drawn):.1f} ms", "", float(np.median(drawn)), "<= 15"),
        Row("- share of the node's time, snapshot included", f"{share:.1%}", "", share, "<= 0.05"),
        Row(f"~/get_trajectory of {min(sizes)} keyframes, longest of {len(plans)}", f"{max(seconds):.2f} s", "", max(seconds), "<= 2"),
        *(
            Row(f"~/query of one pose, {name}", f"{value:.1f} ms", "", value, "<= 20")
            for name, value in zip(("median", "99th percentile"), np.percentile(queries, [50, 99]), strict=True)
        ),
    ]  # fmt: skip


def catch_up(watch: Process) -> None:
    """Until the worker has read everything."""
    lines: list[str] = []
    while len(set(lines[-2:])) != 1 or len(lines) < 2 or not lines[-1].startswith("queue 0 "):
        lines.append(watch.wait_for("queue", 60, len(watch.output.splitlines())))


def asked(processes: Processes, service: str, seconds: float) -> list[tuple[int, float]]:
    """Size of the answer and seconds that it took, of each call."""
    asking = processes.start(LOAD, "ask", service, seconds)
    found = json.loads(asking.wait_for("[", seconds + 40))
    return [(size, took) for size, took in found]


def path_share(node: Backend, processes: Processes, sender: Sender) -> float:
    """Of one core: what the node uses more when somebody listens to its path; mean of three pairs of five seconds."""

    def used() -> float:
        before = node.process.cpu_seconds
        sender.drive(200, 1, 5)
        return (node.process.cpu_seconds - before) / 5

    more = []
    for _ in range(3):
        without = used()
        hearing = processes.start(LOAD, "hear", "/slam_backend/path", PATH)
        hearing.wait_for("first")
        more.append(used() - without)
        hearing.end()
    return float(np.mean(more))


def draws(processes: Processes) -> list[float]:
    """Milliseconds that the node's own code needs to build and publish a path that somebody hears."""
    processes.start(LOAD, "hear", "/draw/path", PATH).wait_for("ready")
    return list(json.loads(processes.start(LOAD, "draw", 2 * HALF, 20).wait_for("[")))


def started() -> list[Row]:
    """Odometry comes all the while, among three processes; to the node, and to a subscriber that does nothing else."""
    ours, bare, ends = [], [], []
    for _ in range(STARTS):
        with TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
            sending = processes.start(LOAD, "send", 5, "at_once")
            sending.wait_for("matched")
            sending.tell("20 5 30 0")
            hearing, _ = (processes.start(LOAD, "hear", "/slam_backend/pose", POSE) for _ in range(2))
            hearing.wait_for("ready")
            time.sleep(SETTLED)
            begin = time.time()
            alone = processes.start(LOAD, "hear", "/odom", ODOMETRY)
            bare.append(first(alone) - begin)
            alone.end()
            begin = time.time()
            node = Backend(processes, Path(folder) / "data", settings=SOURCES)
            ours.append(first(hearing) - begin)
            begin = time.time()
            node.end()
            ends.append(time.time() - begin)
    what = f"start to the first pose, of a bare subscriber to the first message; of {STARTS}"
    return [
        Row(f"Ctrl-C to its end, the run saved, longest of {STARTS}", f"{max(ends):.2f} s", "", max(ends), "<= 2"),
        Row(f"{what}: shortest", f"{min(ours):.2f} s", f"{min(bare):.2f} s", min(ours), "<= 3"),
        Row("- median", f"{median(ours):.2f} s", f"{median(bare):.2f} s", median(ours), "<= 3"),
        Row("- longest", f"{max(ours):.2f} s", f"{max(bare):.2f} s", max(ours), "<= 3"),
    ]  # fmt: skip


def first(hearing: Process) -> float:
    """When it heard its first message, s."""
    return float(hearing.wait_for("first ").split()[1])


# -- live is replay ----------------------------------------------------------------------------------


def equal() -> list[Row]:
    with TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        recordings = dict(recorded(Path(folder)))
        domains = iter(free_domains())
        live = {
            name: [played(processes, *recording, Path(folder) / f"{name}{n}", str(next(domains))) for n in range(3)]
            for name, recording in recordings.items()
        }  # fmt: skip
        for runs in live.values():
            for node, player in runs:
                assert player.wait(CUT / RATE + 60) == 0, player.output
                node.process.signal(signal.SIGINT)
        return [row for name, runs in live.items() for row in compared(name, *recordings[name], runs)]


def recorded(folder: Path) -> Iterator[tuple[str, tuple[Path, Path]]]:
    """Name, bag, configuration of what is played."""
    make_dataset("victoria_park", folder / "whole.mcap")
    park = folder / "park.mcap"
    with open_bag(folder / "whole.mcap") as bag:
        begin = next(bag.records()).log_time
        write_bag(park, takewhile(lambda record: record.log_time < begin + CUT * SECOND, bag.records()))
    yield "Victoria Park", (park, PARK)
    city = write_simulation(simulate("city", 1, Options(poses=10 * CUT)), folder / "city.mcap")
    yield "a simulated city", (city.bag, city.config)


def played(
    processes: Processes, bag: Path, config: Path, folder: Path, domain: str
) -> tuple[Backend, Process]:
    """A node, and a player that waits for it; in a domain of their own."""
    node = Backend(processes, folder, config, seconds=240, ROS_DOMAIN_ID=domain)
    wanted = {TF_STATIC, *(source.topic for source in sb.load_config(config).sources.values())}
    with open_bag(bag) as opened:
        topics = ",".join(wanted & set(opened.topics))
    words = ("play", bag, "--rate", RATE, "--topics", topics)
    return node, processes.start("-m", "slam_backend", *words, seconds=200, ROS_DOMAIN_ID=domain)


def compared(name: str, bag: Path, config: Path, runs: list[tuple[Backend, Process]]) -> list[Row]:
    offline = sb.replay(bag, sb.load_config(config)).result.summary
    live = [node.end(seconds=60) for node, _ in runs]
    sent = offline["counts"]["records"]
    missing = sum(sent - run["counts"]["records"] for run in live)
    whole = [run for run in live if run["counts"]["records"] == sent]
    other = sum(
        run["run_hash"] != node.replayed()["run_hash"] for run, (node, _) in zip(live, runs, strict=True)
    )
    strange = sum(run["run_hash"] != offline["run_hash"] for run in whole)
    return [
        Row(f"{name}: records missing in {len(runs)} runs", f"{missing}", f"{len(runs) * sent} played", missing),
        Row("- runs with another hash than the replay of their journal", f"{other}", f"{len(runs)}", other, "<= 0"),
        Row("- runs with all records and another hash than the replay of the bag", f"{strange}", f"{len(whole)}", strange, "<= 0"),
    ]  # fmt: skip


if __name__ == "__main__":
    for row in rows():
        print(row)
