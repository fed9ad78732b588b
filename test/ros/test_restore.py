"""Killed in the midst of a drive and started again, the node is where it was, and goes on."""

import os
import signal
from itertools import count

import pytest

pytest.importorskip("rclpy")

import slam_backend as sb
from bench.process import gone
from slam_backend.io.restore import examine

WORDS = {"begin": 1, "resume": 2, "config": 3, "end": 1}


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


@pytest.mark.parametrize(
    "configured", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["configured", "found"]
)
def test_a_killed_node_goes_on_where_it_was(backend, peer, drive, configured) -> None:
    """Twice: the node alone, whose worker follows it; then both. Nothing that is in the journal comes again."""
    third, node = len(drive.records) // 3, None
    for life in range(3):
        node = backend(drive.config if configured else None)
        if life:
            node.process.wait_for("its session was not ended, and goes on")
        rest = left_of(drive.records, node.rows() if life else {})
        assert len(rest) == len(drive.records) or life
        peer.play(
            rest[: (life + 1) * third - (len(drive.records) - len(rest))] if life < 2 else rest, rate=20
        )
        if life:
            node.process.wait_for("restored: ")
        if life < 2:
            killed(node, worker_first=life == 1)
    summary = node.end()
    assert summary["run_hash"] == node.replayed()["run_hash"]
    if configured:
        assert not left_of(drive.records, node.rows())
        assert (
            summary["run_hash"]
            == sb.replay(drive.bag, sb.load_config(drive.config)).result.summary["run_hash"]
        )
    found = examine(node.folder / "journal.db3")
    words = [event["event"] for _, event in found.events]
    assert {word: words.count(word) for word in WORDS} == WORDS or not configured
    assert found.damage == []
    assert not (node.folder / "journal-1.db3").exists()


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
