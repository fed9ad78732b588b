"""A finished run in the formats of other programs."""

import json
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from slam_backend.cli import main
from slam_backend.core.errors import BadConfig
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.formats import read_graph, read_trajectory
from slam_backend.io.maps import Origin, export, origin_of
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.simulate import Options, simulate, write_simulation


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    written = write_simulation(simulate("square", 3, Options(poses=150, landmarks=12)), folder / "drive.mcap")
    write_run(replay(written.bag, load_config(written.config)).result, folder / "run")
    return FinishedRun(folder / "run")


def test_a_ply_has_every_keyframe_and_landmark_and_the_path_between(run, tmp_path):
    export(run, tmp_path / "map.ply")
    head, _, body = (tmp_path / "map.ply").read_text().partition("end_header\n")
    keyframes, landmarks = len(run.trajectory), len(run.landmarks)
    assert landmarks > 3
    assert f"element vertex {keyframes + landmarks}\n" in head
    lines = body.splitlines()
    assert len(lines) == keyframes + landmarks + keyframes - 1
    points = np.array([line.split()[:3] for line in lines[: keyframes + landmarks]], dtype=float)
    np.testing.assert_array_equal(points[:keyframes], run.trajectory.sevens[:, :3])
    np.testing.assert_array_equal(points[keyframes:], list(run.landmarks.values()))
    assert lines[-1] == f"{keyframes - 2} {keyframes - 1}"


def test_a_geojson_has_the_path_and_the_landmarks_where_the_origin_puts_them(run, tmp_path):
    """Back from degrees to metres east and north, turned back by the yaw: the map."""
    origin = Origin(49.01, 8.42, 110.0, 30.0)
    export(run, tmp_path / "map.geojson", origin)
    found = json.loads((tmp_path / "map.geojson").read_text())
    line, *points = found["features"]
    assert (found["type"], line["geometry"]["type"]) == ("FeatureCollection", "LineString")
    assert [point["properties"]["name"] for point in points] == list(run.landmarks)
    longitude, latitude, altitude = np.array(line["geometry"]["coordinates"]).T
    east, north, up = pymap3d.geodetic2enu(latitude, longitude, altitude, *origin[:3])
    turn = np.exp(-1j * np.radians(origin.yaw)) * (east + 1j * north)
    back = np.stack([turn.real, turn.imag, up], axis=1)
    np.testing.assert_allclose(back, run.trajectory.sevens[:, :3], atol=1e-3)
    assert len(line["properties"]["stamps"]) == len(run.trajectory)


def test_a_run_converts_to_every_format_of_graphs_and_trajectories(run, tmp_path):
    for name in ("a.tum", "a.csv", "a.euroc"):
        assert main(["convert", str(run.path), str(tmp_path / name)]) == 0
        found = read_trajectory(tmp_path / name)
        np.testing.assert_array_equal(found.stamps, run.trajectory.stamps)
        np.testing.assert_allclose(found.sevens, run.trajectory.sevens, atol=1e-12)
    assert main(["convert", str(run.path), str(tmp_path / "a.kitti")]) == 0
    assert main(["convert", str(run.path), str(tmp_path / "a.g2o")]) == 0
    assert len(read_graph(tmp_path / "a.g2o").ids) == len(run.trajectory)


def test_what_cannot_be_written_is_said_in_one_line(run, tmp_path, capsys):
    for arguments, why in (
        (["a.xyz"], "end it in .g2o"),
        (["a.geojson"], "--origin LAT,LON"),
        (["a.geojson", "--origin", "here"], "write LAT,LON"),
        (["a.geojson", "--origin", "95,8"], "within 90 degrees"),
    ):
        assert main(["convert", str(run.path), str(tmp_path / arguments[0]), *arguments[1:]]) == 2
        assert why in capsys.readouterr().err
    assert main(["convert", str(tmp_path), str(tmp_path / "a.ply")]) == 2
    assert not list(Path(tmp_path).glob("a.*"))


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4,5", "nan,1", "1,181", "1,2,inf"])
def test_an_origin_that_is_none_is_refused(text):
    with pytest.raises(BadConfig, match="--origin"):
        origin_of(text)
