"""Commands by way of the journal: answered when they have been carried out, and honestly when they have not."""

import os
import signal
import threading
import time

import pytest

from slam_backend.core.config import Config
from slam_backend.core.errors import SlamError
from slam_backend.io.configfile import load_config
from slam_backend.ros.session import Session
from slam_backend.ros.state import State


@pytest.fixture
def session(tmp_path, drive):
    """A session that has heard some of the drive, its state, and what went wrong."""
    state, incidents = State(lambda: None), []
    config = load_config(drive.config)
    session = Session(tmp_path, state, incidents.append, config)
    session.work(config)
    for record in drive.records[:300]:
        session.journal.append(record.topic, record.type, bytes(record.data))
    until(
        lambda: session.feeder.backlog == 0 and session.journal.committed >= 300 and state.update is not None
    )
    yield session, state
    os.kill(session.feeder.pid, signal.SIGCONT)
    session.journal.close()
    session.feeder.close()


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def test_what_came_of_a_command_is_its_decision(session):
    session, state = session
    decision = session.command("optimize", {}, 30)
    assert decision.verdict == "accepted"
    assert state.decided[decision.id] == decision
    assert session.command("undo", {}, 30).detail == "there is no edit to undo"


def test_a_worker_that_does_not_come_to_it_is_said_and_the_command_is_done_later(session):
    session, state = session
    os.kill(session.feeder.pid, signal.SIGSTOP)
    with pytest.raises(
        SlamError, match=r"not carried out within 0\.5 s: the worker is busy, 1 records behind"
    ) as told:
        session.command("optimize", {}, 0.5)
    name = str(told.value).rpartition("decision/")[2]
    os.kill(session.feeder.pid, signal.SIGCONT)
    until(lambda: name in state.decided)
    assert state.decided[name].verdict == "accepted"


def test_a_pause_is_said_before_and_after_the_fact(session):
    session, state = session
    state.paused = True
    with pytest.raises(SlamError, match="the inputs are paused"):
        session.command("optimize", {}, 30)
    assert session.journal.waiting == 0
    state.paused = False
    os.kill(session.feeder.pid, signal.SIGSTOP)
    threading.Timer(0.2, lambda: setattr(state, "paused", True)).start()
    with pytest.raises(SlamError, match="the inputs have been paused"):
        session.command("optimize", {}, 0.6)


def test_the_end_of_a_session_ends_the_wait(session):
    session, _ = session
    os.kill(session.feeder.pid, signal.SIGSTOP)
    threading.Timer(0.3, lambda: setattr(session, "_ended", True)).start()
    begin = time.monotonic()
    with pytest.raises(SlamError, match="before the session ended"):
        session.command("optimize", {}, 30)
    assert time.monotonic() - begin < 5


def test_before_anything_is_known_there_is_nothing_to_do(tmp_path):
    session = Session(tmp_path, State(lambda: None), print, Config())
    with pytest.raises(SlamError, match="nothing to optimize yet"):
        session.command("optimize", {}, 30)
    session.end(5)
