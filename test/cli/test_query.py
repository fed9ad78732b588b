"""A finished run answers by name what the back-end itself believed at its end."""

import json
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from slam_backend import cli
from slam_backend.core.consistency import Fit
from slam_backend.core.errors import BadFile
from slam_backend.core.geometry import seven_of_matrix
from slam_backend.core.graph import Factor, keyframe
from slam_backend.core.measurement import SECOND, Array, format_stamp
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.formats import tum
from slam_backend.io.linearized import write_linearized
from slam_backend.io.replay import replay
from slam_backend.io.result import Result
from slam_backend.io.rundir import FILES, write_run

ROOT = Path(__file__).parents[2]
GRAPH = ROOT / "../shared/data/pgo_sesync/smallGrid3D.g2o"
# A kernel, few keyframes and covariances of the messages: all that a run must keep for its answers.
SETTINGS = (
    "keyframes.every=false",
    "keyframes.distance=3.0",
    "keyframes.angle=3.0",
    "landmarks.kernel=cauchy",
    "wheels.noise=twist",
)

Asked = tuple[int, dict[str, Any], str]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    result = replay(ROOT / "bags/warehouse.mcap", load_config(ROOT / "bags/warehouse.yaml"), SETTINGS).result
    out = tmp_path_factory.mktemp("runs") / "warehouse"
    write_run(result, out)
    return result, out


def ask(capsys: pytest.CaptureFixture[str], run: Path, *names: str) -> Asked:
    code = cli.main(["query", str(run), *names, "--json"])
    captured = capsys.readouterr()
    return code, json.loads(captured.out) if captured.out else {}, captured.err


def test_poses_are_those_of_the_back_end(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """At keyframes and, in the shape of the odometry, at every other stamp."""
    result, run = drive
    snapshot = result.snapshot
    wanted = np.random.default_rng(1).integers(snapshot.stamps[0], snapshot.stamps[-1], 40).tolist()
    names = [f"pose@{format_stamp(stamp)}" for stamp in wanted]
    code, found, _ = ask(capsys, run, "pose@now", "pose@k5", *names)
    assert code == 0
    np.testing.assert_allclose(found["pose@now"], snapshot.trajectory.sevens[-1], atol=1e-12)
    np.testing.assert_allclose(found["pose@k5"], snapshot.trajectory.sevens[5], atol=1e-12)
    np.testing.assert_allclose([found[name] for name in names], snapshot.at(wanted), atol=1e-9)


def test_odometry_is_kept_at_every_message_and_makes_poses_better(drive: tuple[Result, Path]) -> None:
    """Against the truth, where keyframes are 3 m apart and the turns lie between them."""
    result, run = drive
    odometry = tum.read(run / "odometry.tum")
    assert len(odometry.stamps) == 5000
    np.testing.assert_allclose(odometry.sevens[0], result.trajectory.sevens[0], atol=1e-12)
    truth = tum.read(ROOT / "bags/warehouse.truth.tum")

    def error(sevens: Array) -> float:
        return float(np.sqrt(np.mean(np.sum((sevens - truth.sevens)[:, :3] ** 2, axis=1))))

    shaped, plain = error(result.snapshot.at(truth.stamps)), error(result.trajectory.at(truth.stamps))
    at_keyframes = np.isin(truth.stamps, result.trajectory.stamps)
    floor = float(
        np.sqrt(np.mean(np.sum((result.trajectory.sevens - truth.sevens[at_keyframes])[:, :3] ** 2, axis=1)))
    )
    assert shaped < 1.1 * floor
    assert shaped < 0.5 * plain


def test_covariances_are_those_of_the_back_end(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result, run = drive
    backend = result.run.backend
    for index in (0, 1, 17, 400, len(result.trajectory) - 1):
        code, found, _ = ask(capsys, run, f"pose@k{index}#cov")
        assert code == 0
        ros = np.array(found[f"pose@k{index}#cov"])
        pose = backend.estimate.pose(keyframe(index, 0).pose)
        expected = backend.estimate.covariance([keyframe(index, 0).pose])
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((backend.space.covariance(ros, pose) - expected) / scale).max() < 1e-6


def test_landmarks_and_decisions_are_those_of_the_back_end(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result, run = drive
    landmark, decision = result.snapshot.names[3], list(result.decisions)[10]
    code, found, _ = ask(capsys, run, f"landmark/{landmark}", f"decision/{decision.id}")
    assert code == 0
    np.testing.assert_array_equal(found[f"landmark/{landmark}"], result.snapshot.landmarks[3])
    said = found[f"decision/{decision.id}"]
    assert (said["verdict"], said["stage"], said["reason"]) == (
        decision.verdict,
        decision.stage,
        decision.reason,
    )


def test_the_last_decision_about_a_factor_holds(drive: tuple[Result, Path], tmp_path: Path) -> None:
    run = copied(drive[1], tmp_path)
    with (run / "decisions.jsonl").open("a") as file:
        for verdict in ("removed", "restored"):
            file.write(json.dumps({"id": "loops/7.0/0", "verdict": verdict}) + "\n")
        file.write(json.dumps({"id": "loops/7.0/01", "detail": "as loops/7.0/0"}) + "\n")
    assert FinishedRun(run).decision("loops/7.0/0") == {"id": "loops/7.0/0", "verdict": "restored"}
    assert FinishedRun(run).decision("loops/7.0") is None


def test_decisions_that_were_shortened_are_damage_and_not_silence(
    drive: tuple[Result, Path], tmp_path: Path
) -> None:
    run = shutil.copytree(drive[1], tmp_path / "run")
    lines = (run / "decisions.jsonl").read_text().splitlines(keepends=True)
    (run / "decisions.jsonl").write_text("".join(lines[: len(lines) // 2]))
    with pytest.raises(
        BadFile, match=r"decisions.jsonl: is damaged: it holds \d+ where .* counts \d+; replay again"
    ):
        FinishedRun(run).decision("loops/1.0/0")


def test_people_read_one_line_for_each_name(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result, run = drive
    decision = {each.id: each for each in result.decisions}[
        next(iter(result.decisions)).id
    ]  # what holds at the end
    names = ["pose@k0", "between@k3,k3", f"decision/{decision.id}", "landmark/nosuch", "pose@now#cov"]
    assert cli.main(["query", str(run), *names]) == 1
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert lines[0] == "pose@k0: 0.000000 0.000000 0.000000 0.000000 0.000000 0.000000 1.000000"
    assert lines[1] == "between@k3,k3: 0.000000 0.000000 0.000000 0.000000 0.000000 0.000000 1.000000"
    assert lines[2].startswith(f"decision/{decision.id}: {decision.verdict} by {decision.stage}/")
    assert lines[3] == "pose@now#cov:"
    assert [len(line.split()) for line in lines[4:]] == [6] * 6
    assert captured.err == "landmark/nosuch: unknown: there is no landmark 'nosuch' among 70\n"


def test_unknown_names_are_null_and_exit_code_one(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    code, found, said = ask(capsys, drive[1], "pose@1.0", "pose@now", "pose@k99999")
    assert code == 1
    assert (found["pose@1.0"], found["pose@k99999"]) == (None, None)
    assert len(found["pose@now"]) == 7
    assert said.count("\n") == 2


def test_a_misspelt_name_is_one_line_and_exit_code_two(
    drive: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    code, found, said = ask(capsys, drive[1], "pose@now", "pose:now")
    assert (code, found) == (2, {})
    assert said.startswith("slam-backend: 'pose:now' is none of pose@<t>, ")
    assert said.count("\n") == 1


@pytest.mark.skipif(not GRAPH.exists(), reason="needs the shared data")
def test_a_run_of_a_graph_file_answers_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its odometry has only the keyframes, so between them interpolation is plain."""
    result = replay(GRAPH).result
    write_run(result, tmp_path / "grid")
    trajectory = result.trajectory
    middle = int(trajectory.stamps[4] + trajectory.stamps[5]) // 2
    name = f"pose@{format_stamp(middle)}"
    code, found, _ = ask(
        capsys, tmp_path / "grid", name, "pose@k4", "pose@k4#cov", f"{name}#cov", "between@k4,k5"
    )
    assert code == 0
    np.testing.assert_allclose(found[name], trajectory.at([middle])[0], atol=1e-9)
    row = int(np.flatnonzero(result.snapshot.indices == 4)[0])
    np.testing.assert_allclose(found["pose@k4"], trajectory.sevens[row], atol=1e-12)
    key = keyframe(4, 0).pose
    backend = result.run.backend
    expected = backend.estimate.covariance([key])
    turned = backend.space.covariance(np.array(found["pose@k4#cov"]), backend.estimate.pose(key))
    np.testing.assert_allclose(turned, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert np.linalg.eigvalsh(np.array(found[f"{name}#cov"]))[0] > 0


def copied(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


def test_what_is_no_run_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("x")
    for path in (tmp_path, tmp_path / "none", tmp_path / "file"):
        code, found, said = ask(capsys, path, "pose@now")
        assert (code, found) == (2, {})
        assert said.startswith(f"slam-backend: {path}: ")
        assert said.count("\n") == 1


@pytest.mark.parametrize("name", ["summary.json", "config.yaml", "trajectory.tum", "odometry.tum", "landmarks.csv",
                                  "decisions.jsonl", "linearized.npz"])  # fmt: skip
@pytest.mark.parametrize("damage", ["missing", "binary", "cut"])
def test_a_missing_or_damaged_file_is_one_line_that_names_it(
    drive: tuple[Result, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, damage: str
) -> None:
    """Every kind of name is asked, so that every file is needed."""
    assert name in FILES
    run = copied(drive[1], tmp_path)
    path = run / name
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        half = len(data) // 2 - 7
        if name == "config.yaml":  # whole lines would be a configuration again: cut within a key
            half = data.rindex(b":", 0, half)
        path.write_bytes(b"\xff\xfe\x00\x01{" if damage == "binary" else data[:half])
    stamp = format_stamp(int(drive[0].trajectory.stamps[-2]) + 7)
    decision = list(drive[0].decisions)[len(list(drive[0].decisions)) // 2].id
    names = ["pose@now", f"pose@{stamp}#cov", "landmark/7", f"decision/{decision}"]
    code, found, said = ask(capsys, run, *names)
    assert (code, found) == (2, {})
    assert said.startswith("slam-backend: ")
    assert name in said
    assert said.count("\n") == 1


def long_run(out: Path, keyframes: int = 7000, samples: int = 20) -> None:
    """A run directory as it would be after hours: a chain of poses, each tenth joined to one far back."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    step = gtsam.Pose3(gtsam.Rot3.Rz(0.01), np.array([1.0, 0, 0]))
    links = [(k - 1, k) for k in range(1, keyframes)] + [(k // 2, k) for k in range(10, keyframes, 10)]
    values, poses = gtsam.Values(), [gtsam.Pose3()]
    for _ in range(keyframes * samples):
        poses.append(poses[-1].compose(gtsam.Pose3.Expmap(gtsam.Pose3.Logmap(step) / samples)))
    for k in range(keyframes):
        values.insert(keyframe(k, 0).pose, poses[k * samples])
    made = [gtsam.PriorFactorPose3(keyframe(0, 0).pose, gtsam.Pose3(), noise)]
    made += [
        gtsam.BetweenFactorPose3(keyframe(i, 0).pose, keyframe(j, 0).pose, step, noise) for i, j in links
    ]
    factors = [Factor(str(n), "any", each, tuple(each.keys()), 0) for n, each in enumerate(made)]
    out.mkdir()
    write_linearized(out / "linearized.npz", Fit(factors, values), np.arange(keyframes))
    stamps = np.arange(len(poses), dtype=np.int64) * (SECOND // 20) + SECOND
    sevens = seven_of_matrix(np.stack([pose.matrix() for pose in poses]))
    last = (keyframes - 1) * samples + 1
    tum.write(out / "odometry.tum", tum.Trajectory(stamps, sevens))
    tum.write(out / "trajectory.tum", tum.Trajectory(stamps[:last:samples], sevens[:last:samples]))
    (out / "config.yaml").write_text("sources: [wheels]\nwheels: {kind: odometry}\n")
    (out / "summary.json").write_text(json.dumps({"counts": {"keyframes": keyframes, "landmarks": 0}}))


def test_seven_thousand_keyframes_answer_within_three_seconds(tmp_path: Path) -> None:
    """The whole process, in CPU time, for one name that needs trajectory, odometry and all factors."""
    long_run(tmp_path / "run")
    command = [sys.executable, "-m", "slam_backend", "query", str(tmp_path / "run"), "pose@6000.512#cov"]

    def cpu() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = cpu()
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    assert cpu() - before < 3


def test_earlier_beliefs_and_what_changed_since(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"VERTEX_SE2 {n} {n} 0 0" for n in range(6)]
    lines += [f"EDGE_SE2 {n} {n + 1} 1 0 0 100 0 0 100 0 100" for n in range(5)]
    (tmp_path / "line.g2o").write_text("\n".join([*lines, "EDGE_SE2 0 4 4.4 0 0 100 0 0 100 0 100"]))
    result, run = replay(tmp_path / "line.g2o").result, tmp_path / "run"
    write_run(result, run)
    third = format_stamp(int(result.trajectory.stamps[3]))
    assert cli.main(["query", str(run), "pose@now", "--as-of", third, "--json"]) == 0
    np.testing.assert_allclose(json.loads(capsys.readouterr().out)["pose@now"][:2], [3, 0], atol=1e-9)
    assert cli.main(["diff", str(run), "--from", third, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [event["id"].split("/")[0] for event in found["events"]] == ["edges"]
    assert found["keyframes"] == [4, 6]
    np.testing.assert_allclose([each["m"] for each in found["moved"]], [0, 0.08, 0.16, 0.24], atol=1e-6)
    assert cli.main(["diff", str(run), "--from", third]) == 0
    assert "3 of 4 keyframes moved" in capsys.readouterr().out
    assert cli.main(["diff", str(run), "--from", "now", "--to", third]) == 2
    assert cli.main(["query", str(run), "pose@now", "--as-of", "999"]) == 1
