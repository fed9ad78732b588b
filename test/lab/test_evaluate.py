"""Errors against a truth: evo's own numbers, from every kind of truth file, and a clear line where there can be none."""

import json
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.errors import BadFile, MissingExtra
from slam_backend.core.geometry import matrix_of, seven_of_matrix
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.formats import write_trajectory
from slam_backend.lab.evaluate import How, evaluate
from slam_backend.lab.simulate import Options, simulate, write_simulation
from slam_backend.lab.truth import load_trajectory, load_truth
from slam_backend.lab.world import exp_of

DATA = Path(__file__).parents[2] / "../shared/data/trajectories/evo"
REAL = {  # truth, format of both, ATE in m as published by evo's author for these files
    "KITTI_00_ORB.txt": ("KITTI_00_gt.txt", "kitti", 1.303),
    "KITTI_00_SPTAM.txt": ("KITTI_00_gt.txt", "kitti", 3.738),
    "fr2_desk_ORB.txt": ("fr2_desk_groundtruth.txt", "tum", 0.0081),
}


@pytest.fixture
def evo():
    return pytest.importorskip("evo", reason="evo is not installed (extra `eval`)")


@pytest.fixture(scope="module")
def truth():
    simulation = simulate("spiral", 4, Options(poses=200))
    return Trajectory(simulation.stamps, simulation.sevens)


@pytest.fixture(scope="module")
def estimate(truth):
    """The truth with errors that grow, and that only every second pose has."""
    rng = np.random.default_rng(5)
    errors = exp_of(np.cumsum(rng.standard_normal((len(truth), 6)) * 0.002, axis=0))
    poses = truth.poses @ errors
    return Trajectory(truth.stamps[::2], seven_of_matrix(poses)[::2])


def by_command(tool, form, truth, estimate, tmp_path, *options):
    """The statistics that evo's own program states, to all digits."""
    saved = tmp_path / f"{tool}-{estimate.stem}.zip"
    command = [Path(sys.executable).parent / tool, form, truth, estimate, *options, "--save_results", saved]
    subprocess.run(
        command, check=True, capture_output=True, env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    )
    stats = json.loads(ZipFile(saved).read("stats.json"))
    saved.unlink()
    return stats


def assert_same(ours, theirs, tolerance=1e-6):
    """sse, a sum over thousands of poses, relative to itself."""
    assert ours.pop("sse") == pytest.approx(theirs.pop("sse"), rel=1e-4)
    assert ours == pytest.approx(theirs, abs=tolerance, rel=0)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("align", "options"),
    [
        ("se3", ("-a",)),
        pytest.param("none", (), marks=SLOW),
        pytest.param("origin", ("--align_origin",), marks=SLOW),
        pytest.param("sim3", ("-a", "-s"), marks=SLOW),
    ],
)
def test_the_numbers_are_those_of_evo_s_own_command(evo, truth, estimate, tmp_path, align, options):
    write_trajectory(tmp_path / "truth.tum", truth)
    write_trajectory(tmp_path / "estimate.tum", estimate)
    files = "tum", tmp_path / "truth.tum", tmp_path / "estimate.tum", tmp_path
    found = evaluate(load_trajectory(files[2]), load_truth(files[1]), How(align, delta=2.0))
    assert_same(found.ate, by_command("evo_ape", *files, *options))
    relative = ("--delta", "2", "--delta_unit", "m")
    assert_same(found.rpe, by_command("evo_rpe", *files, *options, *relative))
    if align == "none":
        degrees = ("-r", "angle_deg")
        assert_same(found.ate_rotation, by_command("evo_ape", *files, *options, *degrees))
        assert_same(found.rpe_rotation, by_command("evo_rpe", *files, *options, *relative, *degrees))


@pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data")
@pytest.mark.parametrize("name", REAL)
def test_published_trajectories_have_their_published_error(evo, name, capsys):
    truth, _, ate = REAL[name]
    assert main(["evaluate", str(DATA / name), "--truth", str(DATA / truth), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)[name]
    assert found["ate"]["rmse"] == pytest.approx(ate, abs=6e-4 if ate > 1 else 6e-5)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data")
@pytest.mark.parametrize("name", REAL)
def test_published_trajectories_are_judged_as_by_evo_s_own_command(evo, name, tmp_path):
    truth, form, _ = REAL[name]
    how = How(by_order=form == "kitti")
    found = evaluate(load_trajectory(DATA / name), load_truth(DATA / truth), how)
    files = form, DATA / truth, DATA / name, tmp_path
    assert_same(found.ate, by_command("evo_ape", *files, "-a"))
    assert_same(found.rpe, by_command("evo_rpe", *files, "-a", "--delta", "1", "--delta_unit", "m"))
    # evo takes KITTI's matrices of six digits as they are, which are not quite rotations; we make rotations of them
    assert_same(found.ate_rotation, by_command("evo_ape", *files, "-a", "-r", "angle_deg"), 1e-5)


def test_every_kind_of_truth_says_the_same(evo, truth, estimate, tmp_path):
    written = write_simulation(simulate("spiral", 4, Options(poses=200)), tmp_path / "drive.mcap")
    expected = evaluate(estimate, truth).ate["rmse"]
    assert expected > 0.01
    for ending in ("tum", "euroc.csv", "csv", "txt"):
        write_trajectory(tmp_path / f"truth.{ending}", truth)
        assert evaluate(estimate, load_truth(tmp_path / f"truth.{ending}")).ate["rmse"] == pytest.approx(
            expected
        )
    assert evaluate(estimate, load_truth(written.bag, "/truth")).ate["rmse"] == pytest.approx(expected)


def test_files_without_stamps_are_compared_pose_by_pose(evo, truth, estimate, tmp_path, capsys):
    same = Trajectory(truth.stamps[::2], truth.sevens[::2])
    for name, each in (("truth", same), ("longer", truth), ("estimate", estimate)):
        write_trajectory(tmp_path / f"{name}.kitti", each)
    command = ["evaluate", str(tmp_path / "estimate.kitti"), "--json", "--truth"]
    assert main([*command, str(tmp_path / "truth.kitti")]) == 0
    found = json.loads(capsys.readouterr().out)["estimate.kitti"]
    assert found["ate"]["rmse"] == pytest.approx(evaluate(estimate, truth).ate["rmse"])
    assert main([*command, str(tmp_path / "longer.kitti")]) == 2
    assert "there are 100 against 200" in capsys.readouterr().err


def test_a_plane_does_not_see_height_and_a_scale_is_found(evo, truth):
    lifted = truth.sevens + np.array([0, 0, 7.0, 0, 0, 0, 0])
    lifted[:, 2] += np.linspace(0, 3, len(lifted))
    turn = matrix_of(np.array([5.0, -3, 0, 0, 0, np.sin(0.4), np.cos(0.4)]))
    flat = Trajectory(truth.stamps, seven_of_matrix(turn @ matrix_of(lifted)))
    assert evaluate(flat, truth, How("se2")).ate["rmse"] < 1e-6 < 0.1 < evaluate(flat, truth).ate["rmse"]
    half = Trajectory(truth.stamps, truth.sevens * np.array([0.5, 0.5, 0.5, 1, 1, 1, 1]))
    found = evaluate(half, truth, How("sim3"))
    assert found.scale == pytest.approx(2.0)
    assert found.ate["rmse"] < 1e-6


def test_a_shifted_clock_is_mended_by_an_offset_and_a_sparse_truth_by_interpolation(evo, truth):
    late = Trajectory(truth.stamps + 50_000_000, truth.sevens)
    with pytest.raises(BadFile, match=r"no moment in common within 0\.01 s: .*--offset"):
        evaluate(truth, late)
    assert evaluate(truth, late, How(offset=-0.05)).ate["rmse"] < 1e-6
    between = Trajectory(
        late.stamps[:-1], truth.at(late.stamps[:-1])
    )  # halfway between the poses of the truth
    nearest, interpolated = (
        evaluate(between, truth, How("none", max_difference=0.06, interpolate=i)) for i in (0, 1)
    )
    assert interpolated.ate["rmse"] < 1e-6 < 0.1 < nearest.ate["rmse"]


def test_of_a_run_all_three_trajectories_are_judged(evo, tmp_path, capsys):
    written = write_simulation(
        simulate("square", 1, Options(poses=300, loop_rate=0.3)), tmp_path / "drive.mcap"
    )
    assert (
        main(["replay", str(written.bag), "--config", str(written.config), "--out", str(tmp_path / "run")])
        == 0
    )
    command = ["evaluate", str(tmp_path / "run"), "--truth", str(written.truth)]
    capsys.readouterr()
    assert main(command) == 0
    assert "RPE m/m" in capsys.readouterr().out
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    ates = [found[name]["ate"]["rmse"] for name in ("trajectory", "online", "odometry")]
    assert ates == sorted(ates)
    assert ates[0] < 0.5 * ates[2]


def test_positions_on_a_line_cannot_be_aligned_and_a_short_path_has_no_pairs(evo):
    stamps = np.arange(10) * 100_000_000
    sevens = np.zeros((10, 7))
    sevens[:, 0], sevens[:, 6] = np.arange(10) * 0.05, 1
    line = Trajectory(stamps, sevens)
    with pytest.raises(BadFile, match=r"on one line .* --align origin"):
        evaluate(line, line)
    found = evaluate(line, line, How("origin"))
    assert found.rpe is None
    assert found.numbers()["rpe"] is None


def test_without_evo_one_line_names_the_extra(truth, estimate, monkeypatch):
    monkeypatch.setitem(sys.modules, "evo.core", None)
    with pytest.raises(MissingExtra, match=r"pip install 'slam_backend\[eval\]'"):
        evaluate(estimate, truth)


def test_a_truth_that_cannot_be_read_is_named(truth, tmp_path):
    written = write_simulation(simulate("square", 1, Options(poses=30)), tmp_path / "drive.mcap")
    with pytest.raises(BadFile, match=r"which topic is the truth.* /odom, /truth"):
        load_truth(written.bag)
    with pytest.raises(BadFile, match="no topic '/gps' with poses"):
        load_truth(written.bag, "/gps")
    with pytest.raises(BadFile, match="is no bag: it has no topic"):
        load_truth(written.truth, "/truth")
    assert main(["evaluate", str(tmp_path), "--truth", str(written.truth)]) == 2
