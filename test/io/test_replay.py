"""Replay: from recorded bytes to a result that is the same every time, everywhere, in every order of arrival."""

import subprocess
import sys
from dataclasses import replace as changed
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from slam_backend.core.command import TOPIC, TYPE, command, text_of
from slam_backend.core.errors import BadConfig, BadFile, SlamError
from slam_backend.core.measurement import SECOND
from slam_backend.core.solvers.batch import polish
from slam_backend.io.bags import open_bag, write_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.encode import encode_odometry, encode_string
from slam_backend.io.records import Record
from slam_backend.io.replay import replay
from slam_backend.lab.simulate import Options, simulate, write_simulation

BAGS = Path(__file__).parents[2] / "bags"
DATA = Path(__file__).parents[2] / "../shared/data"
SMALL = Options(
    poses=400, loop_rate=0.3, landmarks=40, dropout=0.05, late=0.05, late_delay=0.1, duplicated=0.05
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A short drive with loops and landmarks, some messages lost, late by less than the lag, or sent twice."""
    folder = tmp_path_factory.mktemp("drive")
    written = write_simulation(simulate("square", 3, SMALL), folder / "drive.mcap")
    return written.bag, load_config(written.config)


def records(bag):
    with open_bag(bag) as opened:
        return list(opened.records())


def hash_of(bag, config):
    return replay(bag, config).result.summary["run_hash"]


# -- determinism -------------------------------------------------------------------------------------


def test_two_replays_are_equal_to_the_bit(drive):
    first, second = (replay(*drive).result for _ in range(2))
    assert first.trajectory.sevens.tobytes() == second.trajectory.sevens.tobytes()
    assert first.summary["run_hash"] == second.summary["run_hash"]
    assert first.summary["counts"]["loops_accepted"] > 10


def test_to_look_changes_nothing(drive):
    """What is asked on the way, a snapshot or a covariance, leaves no trace in what follows."""
    run = replay(*drive)
    for n, update in enumerate(run):
        if n % 3 == 0:
            run.backend.snapshot()
            run.backend.estimate.covariance([update.keyframe.pose])
    assert run.result.summary["run_hash"] == hash_of(*drive)


def test_another_process_gives_the_same_hash(drive, tmp_path):
    bag, config = drive
    code = (
        "import sys, slam_backend as sb\n"
        "print(sb.replay(sys.argv[1], sb.load_config(sys.argv[2])).result.summary['run_hash'])"
    )
    told = [
        subprocess.run(
            [sys.executable, "-c", code, bag, bag.with_suffix(".yaml")],
            cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True,
        ).stdout.strip()
        for _ in range(2)
    ]  # fmt: skip
    assert told == [hash_of(bag, config)] * 2


@pytest.mark.parametrize("name", ["copy.mcap", "copy"])
@pytest.mark.parametrize("source", ["drive", pytest.param("warehouse", marks=pytest.mark.slow)])
def test_a_copy_in_any_storage_gives_the_same_hash(drive, tmp_path, source, name):
    bag, config = drive
    if source == "warehouse":
        bag, config = BAGS / "warehouse.mcap", load_config(BAGS / "warehouse.yaml")
    write_bag(tmp_path / name, records(bag))
    assert hash_of(tmp_path / name, config) == hash_of(bag, config)


@pytest.mark.parametrize("seed", range(3))
def test_arrival_shuffled_within_the_lag_gives_the_same_hash(drive, tmp_path, seed):
    """Each topic is delayed by a time of its own, which wanders but never lets it overtake itself."""
    bag, config = drive
    rng = np.random.default_rng(seed)
    shuffled = []
    for topic in ("/odom", "/loops", "/landmarks"):
        own = [r for r in records(bag) if r.topic == topic]
        times = np.array([r.log_time for r in own])
        wander = np.interp(times, np.linspace(times[0], times[-1], 40), rng.uniform(0, 0.04, 40)) * SECOND
        arrival = np.maximum.accumulate(times + wander.astype(np.int64) + rng.integers(0, 10**6))
        shuffled += [Record(r.topic, r.type, int(t), r.data) for r, t in zip(own, arrival, strict=True)]
    shuffled.sort(key=lambda r: r.log_time)
    kept = [r for r in records(bag) if r.topic != "/truth"]
    assert [r.data for r in shuffled] != [r.data for r in kept], "the order has changed"
    write_bag(tmp_path / "shuffled.mcap", shuffled, strictly_increasing=True)
    assert "settle/late" not in replay(bag, config).result.summary["decisions"]
    assert hash_of(tmp_path / "shuffled.mcap", config) == hash_of(bag, config)


@pytest.mark.parametrize("what", ["pose", "covariance", "stamp", "loop"])
def test_one_bit_of_one_measurement_gives_another_hash(tmp_path, what):
    """Even where the residual is zero: a drive without any contradiction."""

    def bag(name, spoil):
        numbers = np.zeros((40, 7))
        numbers[:, 0], numbers[:, 6] = np.arange(40) / 3, 1
        noise = np.tile(np.diag([0.01] * 6).ravel(), (40, 1))
        stamps = (np.arange(40) + 1) * SECOND
        loop, loop_noise = np.array([2.0, 0, 0, 0, 0, 0, 1]), np.diag([0.01] * 6)
        if spoil == "pose":
            numbers[25, 0] = np.nextafter(numbers[25, 0], 100)
        elif spoil == "covariance":
            loop_noise[1, 1] *= 1 + 1e-15  # a single bit is lost in the square root of its inverse
        elif spoil == "stamp":
            stamps[25] += 1
        elif spoil == "loop":
            loop[1] = 5e-324
        rows = [
            Record("/odom", "nav_msgs/msg/Odometry", int(s), encode_odometry(int(s), "odom", "base", *row, np.zeros(6), np.zeros(36)))
            for s, *row in zip(stamps, numbers, noise, strict=True)
        ]  # fmt: skip
        ends = "base@4.000000000", "base@10.000000000"
        data = encode_odometry(20 * SECOND, *ends, loop, loop_noise.ravel(), np.zeros(6), np.zeros(36))
        rows.append(Record("/loops", "nav_msgs/msg/Odometry", 41 * SECOND, data))
        write_bag(tmp_path / f"{name}.mcap", rows)
        every = ["keyframes.every=true"]
        return replay(tmp_path / f"{name}.mcap", None, every).result.summary["run_hash"]

    assert bag("one", None) != bag("other", what)


# -- what comes out ----------------------------------------------------------------------------------


def test_the_smoothed_path_is_better_than_odometry(drive):
    bag, config = drive
    result = replay(bag, config).result
    truth = {r.log_time: r for r in records(bag) if r.topic == "/truth"}
    world = simulate("square", 3, SMALL)
    rows = np.searchsorted(world.stamps, result.trajectory.stamps)
    error = {
        name: np.sqrt(np.mean(np.sum((trajectory.sevens[:, :3] - world.sevens[rows, :3]) ** 2, axis=1)))
        for name, trajectory in (("smoothed", result.trajectory), ("odometry", result.snapshot.odometry))
        if len(trajectory) == len(rows)
    }
    assert truth
    assert error["smoothed"] < 0.15
    assert result.summary["cost"]["final"] < result.summary["cost"]["initial"] / 10


def test_updates_come_one_by_one_and_can_be_left_early(drive):
    run = replay(*drive)
    first, second = next(iter(run)), next(iter(run))
    assert first.keyframe.index == 0
    assert second.keyframe.stamp > first.keyframe.stamp
    rest = list(run)
    assert len(rest) + 2 >= len(run.result.trajectory)
    assert all(a.revision <= b.revision for a, b in pairwise(rest))
    assert run.result is run.result


def test_online_is_what_was_believed_when_a_keyframe_was_newest(drive):
    run = replay(*drive)
    told = {update.keyframe.stamp: update.pose for update in reversed(list(run))}
    online = run.online
    assert online.stamps.tolist() == run.result.trajectory.stamps.tolist()
    assert all(
        told[s] == tuple(seven) for s, seven in zip(online.stamps.tolist(), online.sevens, strict=True)
    )


def test_settings_are_applied_to_the_configuration(drive):
    bag, config = drive
    run = replay(bag, config, ["keyframes.every=false", "keyframes.distance=5.0"])
    assert run.config.keyframes.distance == 5.0
    assert len(run.result.trajectory) < 200


def test_without_a_configuration_the_sources_are_found_by_type(drive):
    run = replay(drive[0])
    assert {s.kind for s in run.config.sources.values()} == {"odometry", "relative", "landmark"}
    assert run.config.space == "2d"
    assert any("/truth" in note for note in run.notes)
    assert run.result.summary["counts"]["loops_accepted"] > 10
    assert run.result.summary["counts"]["landmarks"] > 10


def test_sightings_of_a_camera_that_nobody_placed_are_refused_with_that_reason(tmp_path):
    written = write_simulation(simulate("warehouse", 3, Options(poses=60)), tmp_path / "drive.mcap")
    assert not list(replay(written.bag).result.decisions), "the bag says it in /tf_static"
    write_bag(tmp_path / "mute.mcap", [r for r in records(written.bag) if r.topic != "/tf_static"])
    result = replay(tmp_path / "mute.mcap").result
    refused = [d for d in result.decisions if d.reason == "unknown_frame"]
    assert result.summary["decisions"]["landmark/unknown_frame"] > 20
    assert "where is 'camera' on the robot?" in refused[0].detail


def test_bags_in_parts_are_one(drive, tmp_path):
    bag, config = drive
    every = records(bag)
    write_bag(tmp_path / "a.mcap", every[:500])
    write_bag(tmp_path / "b", every[500:])
    assert hash_of([tmp_path / "b", tmp_path / "a.mcap"], config) == hash_of(bag, config)


def test_what_is_wrong_with_single_messages_is_counted_and_the_rest_is_used(drive, tmp_path):
    bag, config = drive
    spoilt = [
        changed(r, data=r.data[: len(r.data) // 2]) if n % 50 == 7 and r.topic == "/odom" else r
        for n, r in enumerate(records(bag))
    ]
    write_bag(tmp_path / "spoilt.mcap", spoilt)
    summary = replay(tmp_path / "spoilt.mcap", config).result.summary
    assert sum(n for rule, n in summary["decisions"].items() if rule.startswith("decode/")) > 3
    assert summary["counts"]["keyframes"] > 200


# -- commands ----------------------------------------------------------------------------------------


def with_command(bag, path, text):
    """A copy of a bag, with a command in its middle."""
    all_ = records(bag)
    middle = len(all_) // 2
    asked = Record(TOPIC, TYPE, all_[middle].log_time, encode_string(text))
    write_bag(path, [*all_[:middle], asked, *all_[middle:]])
    return path


def test_a_bag_that_holds_a_command_is_replayed_with_it(drive, tmp_path):
    """Its effect is in the hash, with or without a configuration."""
    bag, config = drive
    copy = with_command(bag, tmp_path / "asked.mcap", text_of(command("17", "optimize", {})))
    first, second = (replay(copy, config).result for _ in range(2))
    assert first.summary["run_hash"] == second.summary["run_hash"] != hash_of(bag, config)
    assert [d.verdict for d in first.decisions if d.id == "command/17"] == ["accepted"]
    assert replay(copy).result.summary["decisions"]["command/optimize"] == 1


def test_a_command_that_says_nothing_is_a_decision(drive, tmp_path):
    bag, config = drive
    copy = with_command(bag, tmp_path / "asked.mcap", '{"version": 9}')
    result = replay(copy, config).result
    (refused,) = [d for d in result.decisions if d.source == "command"]
    assert (refused.verdict, refused.stage, refused.reason) == ("refused", "decode", "bad_message")
    assert "version 9" in refused.detail
    assert result.trajectory.sevens.tobytes() == replay(bag, config).result.trajectory.sevens.tobytes()


# -- bad input ---------------------------------------------------------------------------------------


def said(*arguments, error=SlamError):
    """The one line that a user reads."""
    with pytest.raises(error) as caught:
        _ = replay(*arguments).result.summary
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_a_missing_empty_or_unrelated_file_is_said_with_its_name(tmp_path):
    empty, text, folder = tmp_path / "empty.mcap", tmp_path / "text.mcap", tmp_path / "folder"
    empty.write_bytes(b"")
    text.write_text("this is no bag\n" * 100)
    folder.mkdir()
    for path in (tmp_path / "missing.mcap", empty, text, folder, tmp_path / "missing.g2o"):
        assert str(path) in said(path, error=BadFile)
    assert "no input" in said([], error=BadFile)


def test_a_truncated_bag_is_used_up_to_the_cut_and_the_damage_is_said(drive, tmp_path):
    bag, config = drive
    whole = bag.read_bytes()
    rng = np.random.default_rng(0)
    for cut in rng.integers(1, len(whole), 25).tolist():
        path = tmp_path / f"cut{cut}.mcap"
        path.write_bytes(whole[:cut])
        try:
            summary = replay(path, config).result.summary
        except SlamError:
            assert str(path) in said(path, config)
        else:
            assert summary["counts"]["keyframes"] > 0
            assert str(path) in summary["damage"][0]


def test_of_a_bag_cut_between_chunks_all_before_is_used(drive, tmp_path):
    bag, config = drive
    path = tmp_path / "small.mcap"
    write_bag(path, records(bag), chunk_bytes=1 << 14)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    result = replay(path, config).result
    assert 100 < result.summary["counts"]["keyframes"] < 250
    (line, *_) = result.summary["damage"]
    assert str(path) in line


def test_a_topic_that_is_not_there_is_said_with_the_nearest_name(drive):
    bag, config = drive
    wheels = config.sources["wheels"].model_copy(update={"topic": "/odon"})
    config = config.model_copy(update={"sources": {**config.sources, "wheels": wheels}})
    line = said(bag, config, error=BadConfig)
    assert "source 'wheels': no topic '/odon'" in line
    assert "did you mean '/odom'" in line


def test_a_topic_of_another_type_is_said_with_what_the_kind_takes(drive):
    bag, config = drive
    wheels = config.sources["wheels"].model_copy(update={"topic": "/landmarks"})
    config = config.model_copy(update={"sources": {"wheels": wheels}})
    line = said(bag, config, error=BadConfig)
    assert "/landmarks" in line
    assert "sensor_msgs/msg/PointCloud2" in line
    assert "nav_msgs/msg/Odometry" in line


def test_a_bag_without_odometry_is_said_with_what_it_has(drive, tmp_path):
    path = tmp_path / "trees.mcap"
    write_bag(path, [r for r in records(drive[0]) if r.topic == "/landmarks"])
    line = said(path, error=BadConfig)
    assert str(path) in line
    assert "/landmarks (sensor_msgs/msg/PointCloud2)" in line


def test_a_bag_of_which_nothing_is_usable_says_why(tmp_path):
    pose = np.array([np.nan, 0, 0, 0, 0, 0, 1])
    data = [
        encode_odometry((n + 1) * SECOND, "odom", "base", pose, np.zeros(36), np.zeros(6), np.zeros(36))
        for n in range(5)
    ]
    path = tmp_path / "nan.mcap"
    write_bag(path, [Record("/odom", "nav_msgs/msg/Odometry", n + 1, d) for n, d in enumerate(data)])
    line = said(path, error=BadFile)
    assert "not one usable message of source 'odom'" in line
    assert "check/not_finite 5" in line


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
@pytest.mark.parametrize("name", ["rosbag2", "rosbagjs", "evo", "plotjuggler"])
def test_bags_of_other_people_are_replayed_or_refused_in_one_line(name):
    folder = DATA / "bags" / name
    bags = sorted(path for path in folder.rglob("*") if path.suffix in {".bag", ".mcap", ".db3"})
    assert bags
    for bag in bags:
        if bag.stat().st_size > 20e6:
            continue
        try:
            run = replay(bag)
            assert next(iter(run), None) is None or run.backend.snapshot()
        except SlamError:
            assert bag.name in said(bag)


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 -1"], "3"),
        (["VERTEX_SE2 0 0 0 0", "EDGE_SE2 0 1 1 0 0 1 0"], "2"),
        (["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "EDGE_SE2 0 7 1 0 0 1 0 0 1 0 1"], "3"),
    ],
)
def test_a_graph_with_an_indefinite_matrix_a_broken_line_or_a_dangling_edge_is_said_with_its_line(
    tmp_path, lines, place
):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    assert f"{path}:{place}" in said(path, error=BadFile)


def test_a_graph_cannot_be_replayed_as_odometry(drive, tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert "is a pose graph: configure a source of kind relative" in said(path, drive[1], error=BadConfig)
    assert "replayed alone" in said([path, drive[0]], error=BadFile)


def test_a_final_batch_ends_at_the_optimum_of_the_kept_factors(tmp_path) -> None:
    """Poses, cost and hash are the batch's; what was believed online is kept beside them."""
    drive = write_simulation(simulate("city", 1, Options(poses=600)), tmp_path / "drive.mcap")
    config = load_config(drive.config)
    plain, ended = (replay(drive.bag, config, final=final).result for final in ("none", "batch"))
    again = polish(ended.factors, ended.values)
    assert ended.summary["cost"]["final"] <= plain.summary["cost"]["final"] * (1 + 1e-12)
    assert max(step.step for step in again.iterations) < 1e-7
    assert ended.summary["cost"]["online"] == plain.summary["cost"]["online"]
    assert ended.summary["batch"]["stop"]
    assert plain.summary["batch"] is None
    assert ended.summary["run_hash"] != plain.summary["run_hash"]
