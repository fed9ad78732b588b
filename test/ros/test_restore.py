"""Killed in the midst of a drive and started again, the node is where it was, and goes on."""

import os
import signal
from itertools import count

import pytest

pytest.importorskip("rclpy")

import slam_backend as sb
from bench.process import gone
from slam_backend.io.restore import examine


def killed(node, worker_first):
    worker = node.worker()
    for pid in (worker, node.process.pid) if worker_first else (node.process.pid,):
        os.kill(pid, signal.SIGKILL)
    assert node.process.wait() == -9
    assert gone([worker], 10)


def left_of(records, rows):
    """What of a drive is not in a journal yet: each topic from its first record that is not there."""
    counts = {topic: count() for topic in {record.topic for record in records}}
    return [record for record in records if next(counts[record.topic]) >= rows.get(record.topic, 0)]


def publish(peer, node, records, complete=()):
    """Each once, in order, to the node that lives; then until the journal holds all of `complete`.

    A killed node still looks alive to DDS: only a reader that was not there before tells that another one listens.
    """
    topics = {record.topic: record.type for record in records}
    dead = readers(peer, topics)
    publishers = {t: peer.publisher(t, k, latched=True) for t, k in topics.items()}
    peer.until(lambda: {topic for topic, _ in readers(peer, topics) - dead} == set(topics))
    peer.spin(0.2)
    for record in records:
        publishers[record.topic].publish(bytes(record.data))
        peer.spin(0.003)
    peer.until(lambda: not left_of(complete, node.rows()), why=lambda: f"the journal holds {node.rows()}")
    for publisher in publishers.values():
        peer.node.destroy_publisher(publisher)


def readers(peer, topics):
    return {
        (t, tuple(found.endpoint_gid))
        for t in topics
        for found in peer.node.get_subscriptions_info_by_topic(t)
    }


@pytest.mark.parametrize(
    "configured", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["configured", "found"]
)
def test_a_killed_node_goes_on_where_it_was(backend, peer, drive, configured) -> None:
    """Twice: the node alone, whose worker follows it; then both. Nothing that is in the journal comes again."""
    config = drive.config if configured else None
    node, third = backend(config), len(drive.records) // 3
    publish(peer, node, drive.records[:third])
    killed(node, worker_first=False)
    for upto in (2 * third, len(drive.records)):
        node = backend(config)
        node.process.wait_for("its session was not ended, and goes on")
        last = upto == len(drive.records)
        publish(peer, node, left_of(drive.records[:upto], node.rows()), drive.records if last else ())
        node.process.wait_for("restored: ")
        if not last:
            killed(node, worker_first=True)
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    if configured:
        replayed = sb.replay(drive.bag, sb.load_config(drive.config)).result.summary
        assert summary["run_hash"] == replayed["run_hash"]
    found = examine(node.folder / "journal.db3")
    words = [event["event"] for _, event in found.events]
    assert (words[0], words.count("resume"), words[-1]) == ("begin", 2, "end")
    assert found.damage == []
    assert not (node.folder / "journal-1.db3").exists()


@pytest.mark.slow
def test_an_ended_session_is_set_aside_and_two_nodes_do_not_share_a_folder(backend, peer, drive) -> None:
    node = backend(drive.config)
    peer.play(drive.records[:100])
    peer.until(lambda: sum(node.rows().values()) == 100)
    other = backend(drive.config, namespace="/other")
    assert other.process.wait(20) == 2
    assert "another process writes its journal there" in other.process.output
    node.end()
    node = backend(drive.config)
    peer.play(drive.records[:10])
    peer.until(lambda: node.rows().get("/odom"))
    node.end()
    assert sum(node.rows("-1").values()) == 100
    assert (node.folder / "run-1").is_dir()
    assert "goes on" not in node.process.output
