"""What a run directory says about the earth."""

import json
from time import sleep

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.errors import BadFile
from slam_backend.core.measurement import format_stamp
from slam_backend.core.query import answers
from slam_backend.core.sensors.gnss import enu
from slam_backend.io.bags import open_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.earth import NAME, read_fixes
from slam_backend.io.feeder import Feeder
from slam_backend.io.finished import FinishedRun
from slam_backend.io.inputs import OWN
from slam_backend.io.journal import Journal
from slam_backend.io.maps import export
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.report import earth, write_report
from slam_backend.lab.report.subject import Subject
from slam_backend.lab.sensing import ORIGIN, on_earth
from slam_backend.lab.simulate import Options, simulate, write_simulation
from slam_backend.ros.believed import Believed

DRIVE = Options(poses=200, loop_rate=0.0, landmarks=3, gnss_every=4, gnss_sigma=0.3)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    made = simulate("city", 4, DRIVE)
    written = write_simulation(made, folder / "drive.mcap")
    settings = ("gps.withhold_every=5", f"earth.origin=[{', '.join(map(str, ORIGIN))}]")
    result = replay(written.bag, load_config(written.config), settings).result
    write_run(result, folder / "run")
    return made, result, FinishedRun(folder / "run")


def test_the_summary_says_how_the_map_lies_and_how_far_the_fixes_are(drive):
    _, _, run = drive
    earth = run.summary["earth"]
    assert earth["origin"] == list(ORIGIN)
    assert earth["fixes"] == {"told": 50, "withheld": 10}
    assert abs(earth["yaw"] - DRIVE.gnss_yaw) < 5 * earth["sigma_yaw"] + 0.2
    assert earth["away"]["used"]["vertical"] is None  # in the plane
    assert earth["away"]["withheld"]["horizontal"] < 1.0
    assert earth["nis"]["gps"]["low"] < earth["nis"]["gps"]["mean"] < earth["nis"]["gps"]["high"]


def test_fixes_csv_holds_what_the_run_compared(drive):
    _, result, run = drive
    again, found = read_fixes(run.path / NAME), result.run.backend.compared(result.snapshot)
    np.testing.assert_array_equal(again.stamps, found.stamps)
    np.testing.assert_array_equal(again.withheld, found.withheld)
    np.testing.assert_allclose(again.antennas, found.antennas, atol=1e-9)
    with pytest.raises(BadFile, match="no source of kind gnss"):
        read_fixes(run.path / "nothing.csv")


@pytest.mark.parametrize("ending", [".geojson", ".kml"])
def test_the_path_lies_where_the_fixes_have_shown_it(drive, tmp_path, ending):
    made, _, run = drive
    target = tmp_path / f"path{ending}"
    export(run, target)
    text = target.read_text()
    if ending == ".kml":
        words = text.split("<coordinates>")[1].split("</coordinates>")[0].split()
        places = np.array([word.split(",") for word in words], dtype=float)
        assert "clampToGround" in text
    else:
        places = np.array(json.loads(text)["features"][0]["geometry"]["coordinates"])
    expected = made.sevens[:, :3] @ on_earth(DRIVE)[:3, :3].T
    away = enu(places[:, [1, 0, 2]], ORIGIN) - expected
    assert np.sqrt(np.mean(away[:, :2] ** 2)) < 0.3


def test_a_living_session_answers_as_its_replay_does(drive, tmp_path):
    """A worker that reads the journal, and the finished run asked for what was believed then: the same to the bit."""
    _, result, run = drive
    config, stamps = result.run.config, result.trajectory.stamps
    journal = Journal(tmp_path, pytest.fail)
    table = {source.topic: (name, source.kind) for name, source in config.sources.items()} | dict(OWN)
    feeder = Feeder(journal, config, table, lambda _: None, pytest.fail)
    with open_bag(result.run.inputs.paths[0]) as bag:
        for record in bag.records({source.topic for source in config.sources.values()} | {"/tf_static"}):
            journal.append(record.topic, record.type, record.data)
    living = feeder.request("snapshot", timeout=60)
    while not len(living.stamps) or living.stamps[-1] < stamps[-5]:
        sleep(0.1)
        living = feeder.request("snapshot", timeout=60)
    names = ["earth", "place@k100", f"place/{result.snapshot.names[0]}"]
    then = f"map@{format_stamp(int(living.stamps[-1]))}/"
    mine, theirs = answers(names, Believed(living, {}, config)), answers([then + name for name in names], run)
    assert [numbers(each.value) for each in mine] == [numbers(each.value) for each in theirs]
    journal.close()
    feeder.finish(str(tmp_path / "saved"), 60)
    assert FinishedRun(tmp_path / "saved").earth.as_json() == run.earth.as_json()


def test_places_are_where_the_robot_was(drive):
    made, result, run = drive
    names = [f"place@k{k}" for k in range(0, 200, 20)]
    places = np.array([each.value for each in answers(names, run)])
    away = enu(places, ORIGIN) - made.sevens[::20, :3] @ on_earth(DRIVE)[:3, :3].T
    assert np.sqrt(np.mean(away[:, :2] ** 2)) < 0.3
    again = answers(names, Believed(result.snapshot, {}, result.run.config))
    np.testing.assert_allclose(places, [each.value for each in again], rtol=0, atol=1e-9)


def numbers(value):
    """Of an answer: an array, or the fields of the earth."""
    fields = value.values() if isinstance(value, dict) else [value]
    return [float(x) for field in fields for x in np.ravel(field)]


def test_what_was_believed_before_the_yaw_was_known_is_that_it_was_not(drive, capsys):
    _, result, run = drive
    early, late = (format_stamp(int(result.trajectory.stamps[n])) for n in (5, 150))
    assert main(["query", str(run.path), f"map@{early}/earth", f"map@{late}/earth", "earth"]) == 0
    before, after, now = capsys.readouterr().out.splitlines()
    assert "not known yet: yaw not yet observable: the fixes reach over" in before
    assert "the map's x axis points" in after
    assert f"origin {' '.join(f'{x:.9f}' for x in ORIGIN)}" in now
    assert main(["query", str(run.path), f"map@{early}/place@now", "place@now"]) == 1
    told = capsys.readouterr()
    assert "the map has no place on the earth yet: yaw not yet observable" in told.err
    assert len(told.out.split()[1].split(".")[1]) == 9


def test_before_the_yaw_is_known_a_run_says_so(tmp_path, capsys):
    written = write_simulation(simulate("city", 4, Options(poses=9, gnss_every=4)), tmp_path / "short.mcap")
    assert (
        main(["replay", str(written.bag), "--config", str(written.config), "--out", str(tmp_path / "run")])
        == 0
    )
    assert "on the earth: unknown (3 fixes): yaw not yet observable" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "run"), str(tmp_path / "a.kml")]) == 2
    assert "--origin LAT,LON" in capsys.readouterr().err


def test_a_run_is_evaluated_against_the_fixes_that_were_kept_back(drive, capsys):
    _, _, run = drive
    assert main(["evaluate", str(run.path), "--truth", "gnss", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["withheld"]["count"], found["used"]["count"]) == (10, 40)
    told = run.summary["earth"]["away"]["withheld"]["horizontal"]
    assert found["withheld"]["rmse"] == pytest.approx(told, rel=1e-6)
    assert found["interpolated"]["rmse"] > 0


def test_the_report_shows_the_fixes_beside_the_path(drive, tmp_path):
    _, _, run = drive
    section = earth.section(Subject(run.path))
    assert set(section.figures) == {"earth", "fixes"}
    names = [trace["name"] for trace in section.figures["earth"]["data"]]
    assert "10 kept back as a truth" in names
    assert names[-1] == "smoothed path"
    write_report(Subject(run.path), tmp_path / "report.html")
    assert "On the earth" in (tmp_path / "report.html").read_text(encoding="utf-8")
