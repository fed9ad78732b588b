"""Tests over real DDS: a domain of their own on this machine, and processes that end.

A test here runs only where rclpy is installed; a module that imports it on top begins with `pytest.importorskip("rclpy")`.
"""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

DOMAINS = range(1, 102)  # whose ports lie below those that Linux gives to others
AGAIN = 5.0  # s after which an unanswered request is repeated
PORTS = 250  # of one domain, from 7400 on


def free_domain() -> int:
    """A domain on whose ports nobody listens; runs at the same time begin to look at different ones."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:] if Path("/proc/net/udp").exists() else []
    taken = {(int(line.split()[1].rpartition(":")[2], 16) - 7400) // PORTS for line in lines}
    first = os.getpid() % len(DOMAINS)
    return next((d for d in (*DOMAINS[first:], *DOMAINS[:first]) if d not in taken), DOMAINS[first])


os.environ["ROS_DOMAIN_ID"] = str(free_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_PYTHON_CHECK_FIELDS"] = (
    "1"  # otherwise a wrong type in a message field is scrambled, not refused
)


@pytest.fixture(autouse=True)
def _rclpy():
    """Skip where ROS is not installed."""
    if find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")


class Process:
    """A python process whose output is kept and whose time is bounded."""

    def __init__(self, arguments: tuple[str, ...], log: Path, seconds: float, environment: dict[str, str]):
        self._log = log
        # --foreground: a signal to `timeout` reaches python once, not twice
        command = ["timeout", "--foreground", "-k", "5", str(seconds), sys.executable, "-u", *arguments]
        with log.open("wb") as output:
            self._timeout = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                env=os.environ | environment, start_new_session=True,
            )  # fmt: skip
        self.pid = self._child()  # of python itself; 0 if it has ended already

    def _child(self) -> int:
        pid = self._timeout.pid
        children = Path(f"/proc/{pid}/task/{pid}/children")
        while self._timeout.poll() is None:
            if found := children.read_text().split():
                return int(found[0])
            time.sleep(0.005)
        return 0

    @property
    def alive(self) -> bool:
        return self._timeout.poll() is None

    @property
    def cpu_seconds(self) -> float:
        """That python has used, in user and system."""
        ticks = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

    @property
    def output(self) -> str:
        """Standard output and errors so far."""
        return self._log.read_text(errors="replace")

    def wait_for(self, text: str, seconds: float = 20) -> str:
        """The first whole line of output that contains the text; fails with the output if there is none in time."""
        until = time.monotonic() + seconds
        while True:
            alive = self.alive  # asked before reading: what a process said before its end counts
            for line in self.output.splitlines(keepends=True):
                if text in line and (line.endswith("\n") or not alive):
                    return line.rstrip("\n")
            assert alive, f"ended without saying '{text}':\n{self.output}"
            assert time.monotonic() < until, f"'{text}' was not said in {seconds} s:\n{self.output}"
            time.sleep(0.02)

    def signal(self, number: int) -> None:
        """To python itself; SIGSTOP and SIGCONT too."""
        if self.alive and self.pid:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def wait(self, seconds: float = 10) -> int:
        """The exit code once it ends by itself; minus the signal's number if one killed it."""
        try:
            code = self._timeout.wait(seconds)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still alive after {seconds} s:\n{self.output}") from None
        return 128 - code if code > 128 else code

    def end(self, seconds: float = 5) -> int:
        """Ask with SIGINT, then insist with SIGKILL; the exit code."""
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGINT)
        try:
            return self.wait(seconds)
        except AssertionError:
            self.signal(signal.SIGKILL)
            return self.wait(5)


@pytest.fixture
def start(tmp_path):
    """`start("-c", code)` or `start("-m", "slam_backend", ...)`: a Process of this python, ended with the test at the latest."""
    started: list[Process] = []

    def begin(*arguments: object, seconds: float = 60, **environment: str) -> Process:
        log = tmp_path / f"process{len(started)}.log"
        started.append(Process(tuple(map(str, arguments)), log, seconds, environment))
        return started[-1]

    yield begin
    for process in started:
        process.end()


@pytest.fixture
def context():
    """A Context of rclpy for nodes of the test's own process."""
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


class Peer:
    """A node of the test's own process: publishes bytes, keeps what it hears, calls services."""

    def __init__(self, context):
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.node = rclpy.create_node("peer", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(left, 0.02))

    def until(self, condition, seconds=20.0, *, why=lambda: ""):
        """Spin until it is so; fails if it is not in time."""
        end = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < end, f"it was not so in {seconds} s; {why()}"
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def publisher(self, topic, type_, *, reliable=True, latched=False, depth=2000):
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        profile = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return self.node.create_publisher(_class_of(type_), topic, profile)

    def hear(self, topic, type_, *, latched=False):
        """A list that fills with the messages of a topic."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        heard = []
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=2000, durability=durability)
        self.node.create_subscription(_class_of(type_), topic, heard.append, profile)
        return heard

    def call(self, type_, service, request=None, seconds=20.0):
        """The response. Asked again after a while: one that comes before DDS has matched both ways is lost."""
        client = self.node.create_client(type_, service)
        assert client.wait_for_service(seconds), f"there is no service {service}"
        end, asked, futures = time.monotonic() + seconds, 0.0, []
        while not (done := [future for future in futures if future.done()]):
            now = time.monotonic()
            assert now < end, f"no answer from {service} in {seconds} s"
            if now > asked + AGAIN:
                futures, asked = [*futures, client.call_async(request or type_.Request())], now
            self._executor.spin_once(timeout_sec=0.02)
        self.node.destroy_client(client)
        return done[0].result()

    def play(self, records, rate=0.0, extra=(), settle=0.2):
        """Publish records once the node listens to all their topics; rate: times the log times, 0: 1,000 a second.

        extra: (number of a record, called before it) pairs.
        """
        records, acts = list(records), dict(extra)
        topics = {record.topic: record.type for record in records}
        publishers = {t: self.publisher(t, k, latched=t.endswith("tf_static")) for t, k in topics.items()}
        self.until(lambda: all(p.get_subscription_count() for p in publishers.values()))
        self.spin(settle)
        begin = time.monotonic()
        for n, record in enumerate(records):
            if n in acts:
                acts[n]()
            due = n / 1000 if rate == 0 else (record.log_time - records[0].log_time) / 1e9 / rate
            if (left := begin + due - time.monotonic()) > 0:
                time.sleep(left)  # what is heard meanwhile waits in its queue
            publishers[record.topic].publish(bytes(record.data))
        for publisher in publishers.values():
            publisher.wait_for_all_acked()
        return publishers


def _class_of(type_):
    package, _, name = type_.split("/")
    return getattr(import_module(f"{package}.msg"), name)


@pytest.fixture
def peer(context):
    peer = Peer(context)
    yield peer
    peer.node.destroy_node()


def gone(pids, seconds=1.0):
    """Whether these processes end by themselves in time; one that nobody has buried yet has ended."""

    def lives(pid):
        with suppress(OSError):
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        return False

    end = time.monotonic() + seconds
    while any(map(lives, pids)):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


class Backend:
    """The node as a process. folder: its data_dir; name: with its namespace."""

    def __init__(self, start, folder, config, arguments, settings, namespace, seconds):
        self.folder, self.name = folder, f"{namespace}/slam_backend"
        words = ["run", "--data-dir", folder]
        words += ["--config", config] if config else []
        words += ["--namespace", namespace] if namespace else []
        words += [word for setting in settings for word in ("--set", setting)]
        self.process = start("-m", "slam_backend", *words, "--", *arguments, seconds=seconds)

    @property
    def children(self):
        """Command lines of its processes, by pid."""
        pid, found = self.process.pid, {}
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            with suppress(OSError):
                for child in task.read_text().split():
                    found[int(child)] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
        return found

    def worker(self, seconds=10.0):
        """The pid of the process that solves."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for pid, command in self.children.items():
                with suppress(OSError):
                    maps = Path(f"/proc/{pid}/maps").read_text()
                    if "spawn_main" in command and "gtsam" in maps and "_rclpy" not in maps:
                        return pid
            time.sleep(0.05)
        raise AssertionError(f"there is no worker:\n{self.process.output}")

    def end(self, number=signal.SIGINT, seconds=20.0):
        """Its summary; it must end well, leave nobody behind and print no traceback."""
        children = self.children
        self.process.signal(number)
        code = self.process.wait(seconds)
        assert code == 0, self.process.output
        assert "Traceback" not in self.process.output, self.process.output
        assert "Failed to publish" not in self.process.output, self.process.output
        assert gone(children)
        return self.summary

    def is_alone(self, pids):
        """Whether none of these processes of its outlived it."""
        return gone(pids)

    @property
    def summary(self):
        return json.loads((self.folder / "run" / "summary.json").read_text())

    def replayed(self, session=""):
        """What replay makes of the journal with the configuration that the run was saved with."""
        import slam_backend as sb

        config = sb.load_config(self.folder / f"run{session}" / "config.yaml")
        return sb.replay(self.folder / f"journal{session}.db3", config).result.summary


@pytest.fixture
def backend(start, tmp_path):
    """`backend(config, ...)`: a node that is about to listen."""

    def begin(config=None, *arguments, settings=(), namespace="", data="data", seconds=60):
        return Backend(start, tmp_path / data, config, arguments, settings, namespace, seconds)

    return begin


class Drive(NamedTuple):
    bag: Path
    config: Path
    records: list


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """A minute of a simulated drive with loops, landmarks and a camera's mount: bag, configuration, records."""
    from slam_backend.io.bags import open_bag
    from slam_backend.lab.simulate import Options, simulate, write_simulation

    folder = tmp_path_factory.mktemp("drive")
    written = write_simulation(
        simulate("warehouse", 2, Options(poses=600, loop_rate=0.3)), folder / "drive.mcap"
    )
    with open_bag(written.bag) as bag:
        records = [record for record in bag.records() if record.topic != "/truth"]
    return Drive(written.bag, written.config, records)
