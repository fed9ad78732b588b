"""A process that looks into the past of a session: it answers as a replay does, and never outlives who asks."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slam_backend.core.errors import SlamError
from slam_backend.core.query import Unknown
from slam_backend.io.configfile import load_config
from slam_backend.io.historian import Historian, Question
from slam_backend.io.replay import replay
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A recording that stands for a journal, its configuration, and a stamp in the middle."""
    folder = tmp_path_factory.mktemp("drive")
    written = write_simulation(
        simulate("square", 3, Options(poses=120, loop_rate=0.3, landmarks=10)), folder / "d.mcap"
    )
    config = load_config(written.config)
    stamps = replay(written.bag, config).result.trajectory.stamps
    return written.bag, config, int(stamps[60]), int(stamps[-1])


def test_it_answers_as_a_replay_that_halts_there_and_begins_anew_when_it_was_killed(drive):
    bag, config, middle, last = drive
    run = replay(bag, config)
    assert run.reach(middle)
    historian = Historian(bag, config, lambda: last)
    try:
        for _ in range(2):
            found = historian.ask(Question("snapshot", middle))
            assert found.trajectory.sevens.tobytes() == run.backend.snapshot().trajectory.sevens.tobytes()
            assert historian.ask(Question("covariance", middle, "7")).shape == (3, 3)
            assert historian.ask(Question("decision", middle, "loops/1.000000000/0")) is None
            with pytest.raises(Unknown, match="lies ahead"):
                historian.ask(Question("snapshot", last + 1))
            os.kill(historian._process.pid, signal.SIGKILL)
            historian._process.join()
            with pytest.raises(SlamError, match="ended before it answered"):
                historian.ask(Question("snapshot", middle))
    finally:
        historian.close()


def test_a_node_that_forgets_to_close_it_still_ends(drive):
    bag, config, middle, _ = drive
    code = (
        "import sys\n"
        "from slam_backend.io.configfile import load_config\n"
        "from slam_backend.io.historian import Historian, Question\n"
        "if __name__ == '__main__':\n"
        "    historian = Historian(sys.argv[1], load_config(sys.argv[2]), lambda: int(sys.argv[3]))\n"
        "    print(len(historian.ask(Question('snapshot', int(sys.argv[3]))).stamps), flush=True)\n"
    )
    script = bag.with_name("node.py")
    script.write_text(code)
    done = subprocess.run(
        [sys.executable, script, bag, bag.with_suffix(".yaml"), str(middle)],
        capture_output=True, text=True, timeout=60, check=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.stdout == "61\n"
    assert config.driver
