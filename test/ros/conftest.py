"""Tests over real DDS: a domain of their own on this machine, and processes that end.

A test here runs only where rclpy is installed; a module that imports it on top begins with `pytest.importorskip("rclpy")`.
"""

import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

from bench.process import Backend, Processes, own_network

AGAIN = 5.0  # s after which an unanswered request is repeated

own_network()


@pytest.fixture(autouse=True)
def _rclpy():
    """Skip where ROS is not installed."""
    if find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")


@pytest.fixture
def processes(tmp_path):
    """Where processes are started; all have ended with the test at the latest."""
    with Processes(tmp_path) as processes:
        yield processes


@pytest.fixture
def start(processes):
    """`start("-c", code)` or `start("-m", "slam_backend", ...)`: a Process of this python."""
    return processes.start


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


@pytest.fixture
def backend(processes, tmp_path):
    """`backend(config, ...)`: a node that is about to listen."""

    def begin(config=None, *arguments, data="data", **options):
        return Backend(processes, tmp_path / data, config, *arguments, **options)

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
