"""The node over DDS, between processes: what runs live is what replay computes, whoever stops or dies meanwhile."""

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from std_srvs.srv import Trigger

import slam_backend as sb
from bench.process import stopped

LOAD = Path(__file__).parents[2] / "bench" / "load.py"
WAREHOUSE = Path(__file__).parents[2] / "bags" / "warehouse.mcap"
ODOMETRY = "nav_msgs/msg/Odometry"


def replayed(drive):
    return sb.replay(drive.bag, sb.load_config(drive.config)).result.summary


def test_what_runs_live_is_what_replay_computes(backend, peer, drive) -> None:
    """At twenty times its speed, undisturbed: the hash is that of the journal's replay, and of the bag's."""
    node = backend(drive.config)
    begin = time.monotonic()
    pose = peer.hear("/slam_backend/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    peer.play(drive.records, rate=20)
    peer.until(lambda: pose)
    summary = node.end()
    assert time.monotonic() - begin < 30
    assert summary["counts"]["records"] == len(drive.records)
    assert summary["run_hash"] == node.replayed()["run_hash"] == replayed(drive)["run_hash"]
    assert node.process.output.count("[ERROR]") == 0


def test_stops_and_deaths_lose_nothing(backend, peer, drive) -> None:
    """The node stands still for a second, then its worker, then the worker is killed."""
    node = backend(drive.config)
    third = len(drive.records) // 4
    acts = {
        third: stopped(lambda: node.process.pid, 1),
        2 * third: stopped(node.worker, 1),
        3 * third: lambda: os.kill(node.worker(), signal.SIGKILL),
    }
    peer.play(drive.records, rate=20, extra=acts.items())
    node.process.wait_for("the worker was lost (it ended with code -9)")
    summary = node.end()
    assert summary["counts"]["records"] == len(drive.records)
    assert summary["run_hash"] == node.replayed()["run_hash"] == replayed(drive)["run_hash"]


def test_what_a_person_asks_is_part_of_the_journal(backend, peer, drive) -> None:
    """An optimization in the midst of the drive, then the worker is killed: the run ends as the journal's replay does."""
    node, answers = backend(drive.config), []

    def ask():
        answers.append(peer.call(Trigger, "/slam_backend/optimize"))

    half = len(drive.records) // 2
    acts = {half: ask, half + 100: lambda: os.kill(node.worker(), signal.SIGKILL)}
    peer.play(drive.records, rate=20, extra=acts.items())
    node.process.wait_for("the worker was lost (it ended with code -9)")
    assert answers[0].success, answers[0].message
    told = json.loads(answers[0].message)
    assert told["cost"]["after"] <= told["cost"]["before"]
    summary = node.end()
    assert summary["decisions"]["command/optimize"] >= 1
    assert summary["run_hash"] == node.replayed()["run_hash"] != replayed(drive)["run_hash"]


@pytest.mark.parametrize(
    "numbers",
    [
        [signal.SIGINT, signal.SIGINT],
        pytest.param([signal.SIGINT], marks=pytest.mark.slow),
        pytest.param([signal.SIGTERM], marks=pytest.mark.slow),
        pytest.param([signal.SIGTERM, signal.SIGINT], marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_it_with_the_run_saved(backend, peer, drive, numbers) -> None:
    """Soon for a small graph (how soon, `bench live` measures); a second signal does not tear the saving."""
    node = backend(drive.config)
    peer.play(drive.records[:150])
    begin = time.monotonic()
    for number in numbers[:-1]:
        node.process.signal(number)
        time.sleep(0.02)
    summary = node.end(numbers[-1])
    assert time.monotonic() - begin < 8
    assert summary["run_hash"] == node.replayed()["run_hash"]
    assert "run hash" in node.process.output


@pytest.mark.parametrize(
    "moment", [1.0, *(pytest.param(t, marks=pytest.mark.slow) for t in (0.0, 0.3, 0.6, 1.4))]
)
def test_a_signal_while_it_starts_ends_it_too(backend, drive, moment) -> None:
    """Wherever it is then: no traceback of its own or of its processes, nobody left behind."""
    node = backend(drive.config)
    time.sleep(moment)
    children = node.children
    node.process.signal(signal.SIGINT)
    assert node.process.wait(10) in (0, 130, -2), node.process.output
    if moment:
        assert "Traceback" not in node.process.output
    assert node.is_alone(children)


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["none", "node stopped", "worker stopped", "worker killed"])
def test_the_warehouse_at_five_times_its_speed(backend, start, trouble) -> None:
    """The bag that ships with the package, by the package's own player, with three seconds of trouble in its midst."""
    config = WAREHOUSE.with_suffix(".yaml")
    node = backend(config, seconds=250)
    player = start(
        "-m", "slam_backend", "play", WAREHOUSE, "--rate", 5, "--depth", 2000, "--wait", 20, "--json",
        "--topics", "/odom,/loops,/landmarks,/tf_static", seconds=200,
    )  # fmt: skip
    node.process.wait_for("listening to /odom")
    time.sleep(50)
    match trouble:
        case "node stopped":
            stopped(lambda: node.process.pid, 3)()
        case "worker stopped":
            stopped(node.worker, 3)()
        case "worker killed":
            os.kill(node.worker(), signal.SIGKILL)
    assert player.wait(150) == 0
    summary = node.end(seconds=60)
    live, offline = summary, sb.replay(WAREHOUSE, sb.load_config(config)).result.summary
    assert live["counts"]["records"] == offline["counts"]["records"]
    assert live["run_hash"] == node.replayed()["run_hash"] == offline["run_hash"]


def latencies(process):
    """Per second of the run: median, 99th percentile, maximum, in ms."""
    process.end()
    heard = np.array(json.loads(process.output.splitlines()[-1]))
    seconds = (heard[:, 0] - heard[0, 0]) // 1e9
    return [tuple(np.percentile(heard[seconds == s, 1], [50, 99, 100])) for s in np.unique(seconds)]


@pytest.mark.slow
@pytest.mark.parametrize(("hz", "loops", "stall"), [(1000, 20, 0), (200, 10, 5), (200, 20, 0)])
def test_at_the_rates_of_a_robot_nothing_is_lost(backend, start, hz, loops, stall) -> None:
    """The journal has every message, though the worker stands still for a while; ~/odometry does not wait for the solver."""
    sources = ["wheels={kind: odometry, topic: /odom}", "loops={kind: relative, topic: /loops}"]
    node = backend(None, settings=["space=2d", "sources=[wheels,loops]", *sources])
    hearing = start(LOAD, "hear", "/slam_backend/odometry", ODOMETRY)
    hearing.wait_for("ready")
    sending = start(LOAD, "send", 5)
    sending.wait_for("matched")
    sending.tell(f"{hz} 10 12 {loops}")
    if stall:
        time.sleep(2)
        stopped(node.worker, stall)()
    _, odometry, _, told, *_ = sending.wait_for("sent ", 40).split()
    assert node.process.cpu_seconds < 12  # a core, its start included
    medians, tails, _ = zip(*latencies(hearing), strict=True)
    assert np.median(medians) < 10  # ms
    assert hz > 200 or np.median(tails) < 20
    summary = node.end()
    assert (
        node.rows()
        == {"/odom": int(odometry), "/loops": int(told)}
        == {"/odom": hz * 12, "/loops": int(told)}
    )
    assert summary["counts"]["records"] == hz * 12 + int(told)
    assert summary["run_hash"] == node.replayed()["run_hash"]
