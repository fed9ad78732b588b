"""What a Rerun viewer is shown of a run."""

import subprocess
import sys

import pytest

from slam_backend.cli import main
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    options = Options(poses=300, loop_rate=0.3, landmarks=10)
    return write_simulation(simulate("square", 3, options), tmp_path_factory.mktemp("drive") / "drive.mcap")


def test_an_rrd_file_holds_path_loops_landmarks_and_residuals(drive, tmp_path):
    pytest.importorskip("rerun")
    recording, run = tmp_path / "new" / "run.rrd", tmp_path / "run"
    arguments = [
        "replay",
        drive.bag,
        "--config",
        drive.config,
        "--no-report",
        "--rerun",
        recording,
        "--out",
        run,
    ]
    assert main(list(map(str, arguments))) == 0
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", recording],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    ).stdout
    for shown in (
        "map/smoothed",
        "map/odometry",
        "map/landmarks",
        "map/loops/accepted",
        "residual/loops",
        "update/ms",
    ):
        assert f"/{shown}" in told


@pytest.mark.parametrize(("target", "says"), [("run.txt", "ends in .rrd"), ("", "needs the Rerun SDK")])
def test_what_cannot_be_shown_is_said_in_one_line(drive, tmp_path, capsys, monkeypatch, target, says):
    if target:
        pytest.importorskip("rerun")
    else:
        monkeypatch.setitem(sys.modules, "rerun", None)  # as where it is not installed
    arguments = [
        "replay",
        drive.bag,
        "--config",
        drive.config,
        "--rerun",
        target or "run.rrd",
        "--out",
        tmp_path / "run",
    ]
    assert main(list(map(str, arguments))) == 2
    assert says in capsys.readouterr().err
