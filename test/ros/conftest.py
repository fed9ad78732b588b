"""Tests over real DDS: a domain of their own on this machine, and processes that end.

A test here runs only where rclpy is installed; a module that imports it on top begins with `pytest.importorskip("rclpy")`.
"""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

DOMAINS = range(1, 102)  # whose ports lie below those that Linux gives to others
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
