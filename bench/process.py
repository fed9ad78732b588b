"""A node, its peers and its load as processes of a network of their own, whose time is bounded; the tests use them too."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import slam_backend as sb

DOMAINS = range(1, 102)  # whose ports lie below those that Linux gives to others
PORTS = 250  # of one domain, from 7400 on


def own_network() -> None:
    """This process and those that it starts: a domain on this machine that nobody else uses; wrong types in messages are refused."""
    os.environ["ROS_DOMAIN_ID"] = str(free_domains()[0])
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # otherwise they are scrambled


def free_domains() -> list[int]:
    """Those on whose ports nobody listens; runs at the same time begin to look at different ones."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:] if Path("/proc/net/udp").exists() else []
    taken = {(int(line.split()[1].rpartition(":")[2], 16) - 7400) // PORTS for line in lines}
    first = os.getpid() % len(DOMAINS)
    return [domain for domain in (*DOMAINS[first:], *DOMAINS[:first]) if domain not in taken]


class Process:
    """A python process whose output is kept and whose time is bounded."""

    def __init__(self, arguments: tuple[str, ...], log: Path, seconds: float, environment: Mapping[str, str]):
        self._log = log
        # --foreground: a signal to `timeout` reaches python once, not twice
        command = ["timeout", "--foreground", "-k", "5", str(seconds), sys.executable, "-u", *arguments]
        with log.open("wb") as output:
            self._timeout = subprocess.Popen(
                command,
                stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT,
                env=os.environ | environment, start_new_session=True, text=True,
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
        return cpu_seconds(self.pid)

    @property
    def output(self) -> str:
        """Standard output and errors so far."""
        return self._log.read_text(errors="replace")

    def tell(self, line: str) -> None:
        """A line on its standard input."""
        assert self._timeout.stdin is not None
        self._timeout.stdin.write(line + "\n")
        self._timeout.stdin.flush()

    def wait_for(self, text: str, seconds: float = 20, after: int = 0) -> str:
        """The first whole line of output, of those after the first `after`, that contains the text; fails with the output if
        there is none in time.
        """
        until = time.monotonic() + seconds
        while True:
            alive = self.alive  # asked before reading: what a process said before its end counts
            for line in self.output.splitlines(keepends=True)[after:]:
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


class Processes:
    """Started here, and ended with it at the latest."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[Process] = []

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._started:
            process.end()

    def start(self, *arguments: object, seconds: float = 60, **environment: str) -> Process:
        """`start("-c", code)` or `start("-m", "slam_backend", ...)`: by this python, ended after so many seconds at the latest."""
        log = self._folder / f"process{len(self._started)}.log"
        self._started.append(Process(tuple(map(str, arguments)), log, seconds, environment))
        return self._started[-1]


def cpu_seconds(pid: int) -> float:
    """That a process has used, in user and system."""
    ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def gone(pids: Any, seconds: float = 1.0) -> bool:
    """Whether these processes end by themselves in time; one that nobody has buried yet has ended."""

    def lives(pid: int) -> bool:
        with suppress(OSError):
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        return False

    end = time.monotonic() + seconds
    while any(map(lives, pids)):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def stopped(pid: Callable[[], int], seconds: float) -> Callable[[], None]:
    """Stop a process for a while, in the midst of what it does."""

    def act() -> None:
        os.kill(pid(), signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid(), signal.SIGCONT)

    return act


class Backend:
    """The node as a process. folder: its data_dir; name: with its namespace."""

    def __init__(
        self,
        processes: Processes,
        folder: Path,
        config: Path | None = None,
        *arguments: object,
        settings: tuple[str, ...] | list[str] = (),
        namespace: str = "",
        seconds: float = 60,
        **environment: str,
    ) -> None:
        self.folder, self.name = folder, f"{namespace}/slam_backend"
        words: list[object] = ["run", "--data-dir", folder]
        words += ["--config", config] if config else []
        words += ["--namespace", namespace] if namespace else []
        words += [word for setting in settings for word in ("--set", setting)]
        self.process = processes.start(
            "-m", "slam_backend", *words, "--", *arguments, seconds=seconds, **environment
        )

    @property
    def children(self) -> dict[int, str]:
        """Command lines of its processes, by pid."""
        pid, found = self.process.pid, {}
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            with suppress(OSError):
                for child in task.read_text().split():
                    found[int(child)] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
        return found

    def worker(self, seconds: float = 10.0) -> int:
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

    def end(self, number: int = signal.SIGINT, seconds: float = 20.0) -> Any:
        """Its summary; it must end well, leave nobody behind and print no traceback."""
        children = self.children
        self.process.signal(number)
        code = self.process.wait(seconds)
        assert code == 0, self.process.output
        assert "Traceback" not in self.process.output, self.process.output
        assert "Failed to publish" not in self.process.output, self.process.output
        assert gone(children)
        return self.summary

    def is_alone(self, pids: Any) -> bool:
        """Whether none of these processes of its outlived it."""
        return gone(pids)

    @property
    def summary(self) -> Any:
        return json.loads((self.folder / "run" / "summary.json").read_text())

    def rows(self, session: str = "") -> dict[str, int]:
        """How many messages the journal holds of each topic that was heard."""
        with sqlite3.connect(self.folder / f"journal{session}.db3") as journal:
            found = journal.execute(
                "SELECT t.name, count(*) FROM messages m JOIN topics t ON t.id = topic_id "
                "WHERE t.name != '/slam_backend/session' GROUP BY 1"
            )
            return dict(found)

    def replayed(self, session: str = "") -> Any:
        """What replay makes of the journal with the configuration that the run was saved with: the summary."""
        config = sb.load_config(self.folder / f"run{session}" / "config.yaml")
        return sb.replay(self.folder / f"journal{session}.db3", config).result.summary
