"""A run that goes on in the map of another: saved to the bit, as good as one run over both, the same each time."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from slam_backend import cli
from slam_backend.core.config import config_from
from slam_backend.core.errors import BadFile, SlamError
from slam_backend.core.measurement import SECOND, format_stamp
from slam_backend.core.query import answers
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.formats import tum
from slam_backend.io.mapfile import NAME, read_map, write_map
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.simulate import Options, simulate, write_simulation

OPTIONS = Options(poses=300, loop_rate=0.3, landmarks=40)
JOINTS = {
    "loops and landmarks": (),
    "loops": ("/landmarks",),
    "landmarks": ("/loops",),
    "nothing": ("/landmarks", "/loops"),
}
FIXES = replace(OPTIONS, gnss_every=5)


class Drive:
    """A world driven through in one go, cut after three fifths into two bags."""

    def __init__(self, folder, world, without, options=OPTIONS):
        written = write_simulation(simulate(world, 3, options), folder / "drive.mcap")
        with open_bag(written.bag) as bag:
            records = [record for record in bag.records() if record.topic not in without]
        middle = (2 * records[0].log_time + 3 * records[-1].log_time) // 5
        self.whole, self.first, self.second = (
            folder / f"{name}.mcap" for name in ("whole", "first", "second")
        )
        write_bag(self.whole, records)
        write_bag(self.first, [record for record in records if record.log_time <= middle])
        write_bag(self.second, [record for record in records if record.log_time > middle])
        config = load_config(written.config)
        kept = {name: source for name, source in config.sources.items() if source.topic not in without}
        self.config = config.model_copy(update={"sources": kept})
        self.truth = tum.read(written.truth)
        self.run = folder / "run"
        self.before = replay(self.first, self.config).result
        write_run(self.before, self.run)

    def error(self, trajectory):
        """ATE (m) after rigid alignment."""
        _, i, j = np.intersect1d(self.truth.stamps, trajectory.stamps, return_indices=True)
        a, b = trajectory.sevens[j, :3], self.truth.sevens[i, :3]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        u, _, vt = np.linalg.svd(b.T @ a)
        turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
        return float(np.sqrt(np.mean(np.sum((a @ turn.T - b) ** 2, axis=1))))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return Drive(tmp_path_factory.mktemp("drive"), "square", ())


@pytest.fixture(scope="module")
def went_on(drive):
    result = replay(drive.second, continued=drive.run).result
    write_run(result, drive.run.with_name("on"))
    return result, drive.run.with_name("on")


@pytest.mark.parametrize(
    ("world", "joint"),
    [
        *(("square", joint) for joint in JOINTS),
        *(pytest.param("spiral", joint, marks=pytest.mark.slow) for joint in JOINTS),
    ],
)
def test_the_joined_map_is_as_good_as_one_run_over_both(tmp_path, world, joint):
    """Without anything between them the two stay apart, each with a gauge of its own."""
    drive = Drive(tmp_path, world, JOINTS[joint])
    result = replay(drive.second, continued=drive.run).result
    whole = replay(drive.whole, drive.config).result
    assert len(result.trajectory) == len(whole.trajectory)
    assert result.summary["counts"]["parts"] == (2 if joint == "nothing" else 1)
    if joint != "nothing":
        assert drive.error(result.trajectory) < 1.1 * drive.error(whole.trajectory) + 0.01
    old = result.trajectory.sevens[: len(drive.before.trajectory)]
    moved = np.linalg.norm(old[:, :3] - drive.before.trajectory.sevens[:, :3], axis=1).max()
    assert moved < (1e-9 if joint == "nothing" else 0.5), "the old trajectory stays"


@pytest.mark.parametrize("world", ["square", pytest.param("spiral", marks=pytest.mark.slow)])
def test_fixes_alone_join_what_goes_on(tmp_path, world):
    """The map knows its earth, and the new drive is laid there; a single fix is 0.5 m off on each axis."""
    drive = Drive(tmp_path, world, JOINTS["nothing"], FIXES)
    result = replay(drive.second, continued=drive.run).result
    assert result.summary["counts"]["parts"] == 1
    assert result.summary["decisions"]["gnss/joined"] == 1
    assert drive.error(result.trajectory) < 0.25
    assert replay(drive.second, continued=drive.run).result.summary["run_hash"] == result.summary["run_hash"]


def test_what_is_saved_is_read_to_the_bit(drive, tmp_path):
    backend = drive.before.run.backend
    saved, back = backend.saved(drive.before.run.online), read_map(drive.run)
    for mine, other in zip(saved.factors, back.factors, strict=True):
        assert (mine.id, mine.kind, mine.keys, mine.stamp, mine.stamps) == (
            other.id, other.kind, other.keys, other.stamp, other.stamps,
        )  # fmt: skip
        linear = [
            f.factor.linearize(v).augmentedJacobian() for f, v in ((mine, saved.values), (other, back.values))
        ]
        assert linear[0].tobytes() == linear[1].tobytes()
    assert [k.stamp for k in back.keyframes] == [k.stamp for k in saved.keyframes]
    assert (back.landmarks, back.parts, back.revision) == (saved.landmarks, saved.parts, saved.revision)
    for mine, other in zip(saved.tracks, back.tracks, strict=True):
        assert mine.stamps.tolist() == other.stamps.tolist()
        assert mine.numbers.tobytes() == other.numbers.tobytes()
    assert back.online.sevens.tobytes() == saved.online.sevens.tobytes()
    assert back.run_hash == drive.before.summary["run_hash"]
    write_map(tmp_path / NAME, back)
    again = read_map(tmp_path)
    assert again.values.equals(back.values, 0.0)


def test_a_continued_run_is_the_same_each_time(drive, went_on):
    result, _ = went_on
    assert replay(drive.second, continued=drive.run).result.summary["run_hash"] == result.summary["run_hash"]


def test_its_directory_is_that_of_the_whole_map(drive, went_on):
    result, out = went_on
    finished, before = FinishedRun(out), FinishedRun(drive.run)
    assert len(finished.trajectory) == len(result.trajectory)
    assert finished.trajectory.breaks.tolist() == result.trajectory.breaks.tolist()
    assert json.loads((out / "summary.json").read_text())["sessions"] == [
        format_stamp(int(before.trajectory.stamps[0])), format_stamp(int(result.trajectory.breaks[0])),
    ]  # fmt: skip
    online = tum.read(out / "online.tum")
    assert len(online.stamps) == len(result.trajectory)
    assert (
        online.sevens[: len(before.trajectory)].tobytes()
        == tum.read(drive.run / "online.tum").sevens.tobytes()
    )
    gap = (int(before.trajectory.stamps[-1]) + int(result.trajectory.breaks[0])) // 2
    found = answers([f"pose@{format_stamp(gap)}", "pose@now", "pose@now#cov", "pose@k3#cov"], finished)
    assert found[0].why.endswith("lies between two sessions")
    assert all(answer.value is not None for answer in found[1:])


def test_a_third_run_goes_on_in_the_second(drive, went_on, tmp_path):
    """The same drive once more, an hour later, as the odometry alone tells it: apart, and nothing of the map is lost."""
    _, out = went_on
    config = load_config(out / "config.yaml")
    alone = config.model_copy(update={"sources": {config.driver: config.sources[config.driver]}})
    written = write_simulation(
        simulate("square", 5, Options(poses=50, loop_rate=0.0, landmarks=0)), tmp_path / "drive.mcap"
    )
    with open_bag(written.bag) as bag:
        later = [_later(record, 3600 * SECOND) for record in bag.records() if record.topic == "/odom"]
    write_bag(tmp_path / "later.mcap", later)
    result = replay(tmp_path / "later.mcap", alone, continued=out).result
    assert result.summary["counts"]["keyframes"] == len(FinishedRun(out).trajectory) + 50
    assert result.summary["counts"]["parts"] == 2
    assert len(result.trajectory.breaks) == 2
    assert len({factor.id for factor in result.factors}) == len(result.factors)


def _later(record, by):
    """An odometry message as if it had been sent later: CDR has the stamp right after its head."""
    seconds = int.from_bytes(record.data[4:8], "little") + by // SECOND
    data = record.data[:4] + seconds.to_bytes(4, "little") + record.data[8:]
    return type(record)(record.topic, record.type, record.log_time + by, data)


def test_earlier_beliefs_reach_back_into_the_map_that_was_continued(drive, went_on):
    result, out = went_on
    stamps, n = result.trajectory.stamps.tolist(), len(drive.before.trajectory)
    early, late = FinishedRun(out).past(stamps[n // 2]), FinishedRun(out).past(stamps[n + 20])
    assert (
        early.trajectory.sevens.tobytes()
        == FinishedRun(drive.run).past(stamps[n // 2]).trajectory.sevens.tobytes()
    )
    assert len(late.trajectory) == n + 21
    again = replay(drive.second, continued=drive.run)
    again.reach(stamps[n + 20])
    assert late.trajectory.sevens.tobytes() == again.backend.snapshot().trajectory.sevens.tobytes()
    assert FinishedRun(out).between(stamps[n + 5], stamps[n + 40]).keyframes == (n + 6, n + 41)


def test_a_continued_run_is_edited_as_a_whole(drive, went_on, tmp_path, capsys):
    """A loop of either session; decided anew can be only what was said in the later one."""
    out = tmp_path / "on"
    shutil.copytree(went_on[1], out)
    loops = [factor.id for factor in went_on[0].factors if factor.kind == "loop"]
    old, new = loops[0], loops[-1]
    assert old in {factor.id for factor in drive.before.factors}
    counts = FinishedRun(out).summary["counts"]

    def edit(*arguments):
        capsys.readouterr()
        code = cli.main(["edit", str(out), *arguments])
        return code, capsys.readouterr().err

    assert edit("--disable", old, "--disable", new) == (0, "")
    edited = FinishedRun(out)
    assert edited.summary["counts"]["factors"] == counts["factors"] - 2
    assert len(edited.trajectory) == counts["keyframes"]
    assert edited.summary["sessions"] == went_on[0].summary["sessions"]
    code, error = edit("--remove", new, "--replay")
    assert (code, error.count("\n")) == (2, 1)
    assert f"then edit {drive.run}" in error
    assert edit("--undo") == (0, "")
    assert FinishedRun(out).summary["counts"]["factors"] == counts["factors"]
    assert edit("--remove", new, "--replay") == (0, "")
    assert FinishedRun(out).summary["counts"]["loops_offered"] == counts["loops_offered"] - 1
    third = replay(drive.second, continued=drive.run).result.summary["run_hash"]
    assert third == went_on[0].summary["run_hash"], "the run that is continued is not touched"


def test_what_is_not_later_than_the_map_is_refused(drive, tmp_path):
    with pytest.raises(BadFile, match=r"not one usable message .*session/overlap.*which ends at 17000000"):
        replay(drive.first, continued=drive.run).result  # noqa: B018
    with open_bag(drive.whole) as bag:
        records = list(bag.records())
    write_bag(tmp_path / "overlap.mcap", records[len(records) // 3 :])
    overlap = replay(tmp_path / "overlap.mcap", drive.config, continued=drive.run).result
    exact = replay(drive.second, drive.config, continued=drive.run).result
    assert overlap.summary["decisions"]["session/overlap"] > 10
    assert len(overlap.trajectory) == len(exact.trajectory)
    with pytest.raises(BadFile, match="a pose graph has no stamps of its own"):
        replay(drive.run / "graph.g2o", config_from({"space": "2d"}), continued=drive.run)


@pytest.mark.parametrize("harm", ["no directory", "no map", "cut", "flipped", "another version"])
def test_a_map_that_cannot_be_read_is_one_line(drive, tmp_path, harm):
    run = tmp_path / "run"
    shutil.copytree(drive.run, run)
    data = (run / NAME).read_bytes()
    if harm == "no directory":
        shutil.rmtree(run)
    elif harm == "no map":
        (run / NAME).unlink()
    elif harm == "cut":
        (run / NAME).write_bytes(data[: len(data) // 2])
    elif harm == "flipped":
        (run / NAME).write_bytes(data[:9000] + bytes(200) + data[9200:])
    else:
        with np.load(run / NAME) as file:
            np.savez(run / NAME, **{**file, "version": np.int64(99)})
    with pytest.raises(BadFile, match=str(run)) as raised:
        read_map(run)
    assert "\n" not in str(raised.value)


def test_the_command_line_goes_on_and_does_not_overwrite_what_it_goes_on_from(drive, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        cli.main(["replay", str(drive.second), "--continue", str(drive.run), "--out", str(out), "--json"])
        == 0
    )
    summary = json.loads(capsys.readouterr().out)
    assert summary["continued"] == str(drive.run)
    assert cli.main(["replay", str(drive.second), "--continue", str(drive.run), "--out", str(drive.run)]) == 2
    assert "is the run that is continued" in capsys.readouterr().err
    assert cli.main(["replay", str(drive.second), "--continue", str(tmp_path / "nowhere")]) == 2


def test_another_space_is_refused(drive):
    spatial = drive.config.model_copy(update={"space": "3d"})
    with pytest.raises(SlamError, match="run: the map was made in space 2d, and this is space 3d"):
        replay(drive.second, spatial, continued=drive.run)
