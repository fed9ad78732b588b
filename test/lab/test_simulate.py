"""Simulated drives are repeatable, their noise is what they state, and their losses are what was asked for."""

import itertools
from collections import Counter
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml

from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig
from slam_backend.core.geometry import inverse_of, matrix_of
from slam_backend.core.measurement import SECOND, parse_stamp
from slam_backend.core.sensors import SENSORS
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.odometry import OdometryPose
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.io.bags import open_bag
from slam_backend.lab.sensing import axes_of, drifted, step_sigmas
from slam_backend.lab.simulate import SCENARIOS, Options, simulate, write_simulation
from slam_backend.lab.world import chain, exp_of

SHORT = Options(poses=600)


def test_the_exponential_is_gtsams() -> None:
    """For large, small and zero tangents."""
    tangents = np.random.default_rng(0).normal(size=(60, 6)) * np.repeat([1.0, 1e-3, 1e-6], 20)[:, None]
    tangents[0] = 0
    expected = [gtsam.Pose3.Expmap(tangent).matrix() for tangent in tangents]
    np.testing.assert_allclose(exp_of(tangents), expected, atol=1e-14)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_scenario_starts_at_the_origin_and_moves_half_a_metre_a_step(scenario: str) -> None:
    """Planar ones stay in the plane, and every topic that the configuration names has messages."""
    simulation = simulate(scenario, 3, SHORT)
    steps = np.linalg.norm(np.diff(simulation.sevens[:, :3], axis=0), axis=1)
    np.testing.assert_allclose(simulation.sevens[0], [0, 0, 0, 0, 0, 0, 1], atol=1e-15)
    assert 0.4 < steps.min() <= steps.max() < 0.6
    if SCENARIOS[scenario].space == "2d":
        assert not simulation.sevens[:, 2:5].any()
    config = config_from(simulation.settings)
    topics = {sent.topic for sent in simulation.sent}
    assert topics == {source.topic for source in config.sources.values()} | {"/truth"}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    options = Options(poses=600, dropout=0.1, late=0.1, duplicated=0.1, wrong_loop_rate=0.2)
    once, again, other = (list(simulate("warehouse", seed, options).records) for seed in (5, 5, 6))
    assert [(r.topic, r.type, r.log_time, r.data) for r in once] == [
        (r.topic, r.type, r.log_time, r.data) for r in again
    ]
    assert [r.data for r in once] != [r.data for r in other]
    assert all(a.log_time < b.log_time for a, b in itertools.pairwise(once))


def test_other_loops_leave_the_odometry_as_it_was() -> None:
    some, none = (simulate("square", 2, Options(poses=600, loop_rate=rate)) for rate in (0.5, 0.0))
    poses = [[m.pose for m in s.measurements if isinstance(m, OdometryPose)] for s in (some, none)]
    np.testing.assert_array_equal(*poses)
    assert some.loops
    assert not none.loops


@pytest.mark.parametrize("scenario", ["square", "spiral"])
def test_odometry_ends_where_its_noise_model_says(scenario: str) -> None:
    """Over 500 runs the end errors have the covariance of a chain of motions with the configured sigmas."""
    runs, options, world = 500, Options(poses=61), SCENARIOS[scenario]
    steps = exp_of(world.path(options.poses, np.random.default_rng(0)))
    translation, rotation = step_sigmas(steps, options)
    predicted = np.zeros((6, 6))
    for step, t, r in zip(steps, translation, rotation, strict=True):
        adjoint = gtsam.Pose3(step).inverse().AdjointMap()
        predicted = adjoint @ predicted @ adjoint.T + np.diag(
            np.repeat([r**2, t**2], 3) * axes_of(world.space)
        )
    rng, end = np.random.default_rng(1), inverse_of(chain(steps)[-1])
    ends = [drifted(steps, options, world.space, rng)[-1] for _ in range(runs)]
    errors = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(end @ pose)) for pose in ends])
    used = axes_of(world.space) > 0
    assert not errors[:, ~used].any()
    errors, predicted = errors[:, used], predicted[np.ix_(used, used)]
    freedom = runs * used.sum()
    nees = np.einsum("ni,ij,nj->", errors, np.linalg.inv(predicted), errors)
    assert abs(nees - freedom) < 4 * np.sqrt(2 * freedom)
    ratios = (errors**2).sum(axis=0) / np.diag(predicted)  # chi-square with `runs` degrees of freedom, each
    assert (np.abs(ratios - runs) < 4 * np.sqrt(2 * runs)).all()


def test_the_path_and_turn_sigmas_are_those_of_the_configuration() -> None:
    """1 m straight and 1 rad on the spot give back the four numbers."""
    steps = exp_of(np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 1.0, 0, 0, 0], [0, 0, 1e-9, 0, 0, 0]]))
    options = Options(
        sigma_translation_per_meter=1, sigma_translation_per_radian=2,
        sigma_rotation_per_meter=3, sigma_rotation_per_radian=4,
    )  # fmt: skip
    translation, rotation = step_sigmas(steps, options)
    np.testing.assert_allclose(translation, [1, 2, 2 * np.sqrt(1e-9)])
    np.testing.assert_allclose(rotation, [3, 4, 4 * np.sqrt(1e-9)])


def test_the_twist_tells_the_step_and_its_covariance() -> None:
    """Over one period it leads from the message before to this one."""
    simulation = simulate("square", 0, SHORT)
    odometry = [m for m in simulation.measurements if isinstance(m, OdometryPose)]
    poses = matrix_of([m.pose for m in odometry])
    steps = inverse_of(poses[:-1]) @ poses[1:]
    translation, rotation = step_sigmas(steps, SHORT)
    for step, t, r, message in zip(steps, translation, rotation, odometry[1:], strict=True):
        log = gtsam.Rot3.Logmap(gtsam.Rot3(step[:3, :3]))
        np.testing.assert_allclose(message.twist * SHORT.period, [*step[:3, 3], *log], atol=1e-12)
        expected = np.diag(np.repeat([t**2, r**2], 3)) / SHORT.period**2
        np.testing.assert_allclose(message.twist_covariance.reshape(6, 6), expected, rtol=1e-9)


def test_the_long_city_drifts_more_than_ten_metres() -> None:
    """With seed 1 and 5,000 poses, and it returns to places often."""
    simulation = simulate("city", 1)
    *_, last = (m for m in simulation.measurements if isinstance(m, OdometryPose))
    assert len(simulation.stamps) == 5000
    assert np.linalg.norm(last.pose[:3] - simulation.sevens[-1, :3]) > 10
    assert len(simulation.loops) > 100


def test_right_loops_fit_the_truth_and_wrong_ones_come_at_the_asked_rate() -> None:
    """Right: chi-square with three degrees of freedom each. Wrong: ends that are ten metres apart or more."""
    simulation = simulate("city", 4, Options(loop_rate=1.0, wrong_loop_rate=0.3))
    truth = matrix_of(simulation.sevens)
    messages = [m for m in simulation.measurements if isinstance(m, RelativePose)]
    wrong = np.array([loop.wrong for loop in simulation.loops])
    assert len(messages) == len(wrong) > 1000
    assert abs(wrong.sum() - 0.3 * len(wrong)) < 4 * np.sqrt(0.3 * 0.7 * len(wrong))
    row = {int(stamp): k for k, stamp in enumerate(simulation.stamps)}
    squares = []
    for message in sorted(messages, key=lambda m: m.stamp_j):
        assert message.stamp == message.stamp_j + SECOND // 5
        i_T_j = inverse_of(truth[row[message.stamp_i]]) @ truth[row[message.stamp_j]]
        error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse_of(i_T_j) @ matrix_of(message.pose)))
        squares.append(((error[2:5] / [0.01, 0.05, 0.05]) ** 2).sum())
        assert np.linalg.norm(message.pose[:3]) < 2.5
    right = np.array(squares)[~wrong]
    assert abs(right.mean() - 3) < 4 * np.sqrt(6 / len(right))
    assert np.array(squares)[wrong].min() > 1000


def test_landmarks_are_seen_with_the_stated_noise() -> None:
    """Through a camera that looks ahead from its place on the robot."""
    simulation = simulate("warehouse", 0, Options(poses=1500))
    config = config_from(simulation.settings)
    x, y, z, roll, pitch, yaw = config.extrinsics["camera"]
    camera = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array((x, y, z)))
    truth = dict(zip(simulation.stamps.tolist(), matrix_of(simulation.sevens), strict=True))
    errors = []
    for seen in simulation.measurements:
        if isinstance(seen, LandmarkObservation):
            sensor = gtsam.Pose3(truth[seen.stamp]).compose(camera)
            expected = sensor.transformTo(simulation.landmarks[int(seen.landmark)])
            assert np.linalg.norm(expected) < 8
            errors.append((seen.value - expected) / np.sqrt(np.diag(seen.covariance)))
    count = np.size(errors)
    assert count > 1000
    assert abs(np.square(errors).sum() - count) < 4 * np.sqrt(2 * count)


def test_losses_come_at_the_asked_rates_and_spare_the_truth() -> None:
    """Dropped messages never arrive, duplicated ones twice, late ones late, and silence is silent."""
    clean = simulate("warehouse", 1, Options(poses=3000))
    options = Options(
        poses=3000, dropout=0.1, duplicated=0.05, late=0.2, late_delay=3.0, silence_start=100, silence=20
    )
    lossy = simulate("warehouse", 1, options)
    before, after = (Counter(sent.topic for sent in s.sent) for s in (clean, lossy))
    offered = before.total() - before["/truth"] - lossy.lost["silent"]
    arriving = offered - lossy.lost["dropped"]
    assert after["/truth"] == before["/truth"] == 3000
    assert after.total() - 3000 == arriving + lossy.lost["duplicated"]
    for what, rate, of in (
        ("dropped", 0.1, offered),
        ("late", 0.2, arriving),
        ("duplicated", 0.05, arriving),
    ):
        assert abs(lossy.lost[what] - rate * of) < 4 * np.sqrt(rate * (1 - rate) * of), what
    start = int(lossy.stamps[0]) + 100 * SECOND
    quiet = [m for m in lossy.measurements if start <= m.stamp < start + 20 * SECOND]
    assert not quiet
    waits = [sent.arrival - sent.measurements[0].stamp for sent in lossy.sent]
    twice = len(
        {id(sent.content) for sent in lossy.sent if sent.arrival - sent.measurements[0].stamp >= 3 * SECOND}
    )
    assert twice == lossy.lost["late"]
    assert min(waits) >= 0


@pytest.mark.parametrize("scenario", ["city", "warehouse", "spiral"])
def test_decoding_the_bag_gives_the_measurements_and_the_truth_in_it_is_the_tum_file(
    scenario: str, tmp_path
) -> None:
    """Bit for bit, through the decoders that every bag goes through; and the configuration beside it reads."""
    simulation = simulate(scenario, 7, Options(poses=400, loop_rate=0.5))
    written = write_simulation(simulation, tmp_path / "drive.mcap")
    assert written.truth == tmp_path / "drive.truth.tum"
    config = config_from(yaml.safe_load(written.config.read_text()))
    assert config == config_from(simulation.settings)
    decoders = {s.topic: (name, SENSORS[s.kind].decoders) for name, s in config.sources.items()}
    decoders["/truth"] = ("truth", SENSORS["odometry"].decoders)
    decoders["/tf_static"] = ("tf_static", SENSORS["static"].decoders)
    decoded, truth = [], []
    with open_bag(written.bag) as bag:
        for record in bag.records():
            name, table = decoders[record.topic]
            message = bag.typestore.deserialize_cdr(record.data, record.type)
            found = table[record.type](message, name)
            items = [found] if record.type.endswith("Odometry") else list(found)
            if name == "tf_static":
                assert scenario == "warehouse"
                continue
            (truth if name == "truth" else decoded).extend(items)
    expected = list(simulation.measurements)
    assert len(decoded) == len(expected)
    for a, b in zip(decoded, expected, strict=True):
        assert type(a) is type(b)
        for field in type(b).__dataclass_fields__:
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    lines = [line.split() for line in written.truth.read_text().splitlines()]
    assert [parse_stamp(line[0]) for line in lines] == [m.stamp for m in truth] == simulation.stamps.tolist()
    np.testing.assert_array_equal(
        np.array([line[1:] for line in lines], dtype=float), [m.pose for m in truth]
    )
    np.testing.assert_array_equal([m.pose for m in truth], simulation.sevens)


def test_wrong_loops_are_listed_beside_the_bag(tmp_path) -> None:
    """So that verdicts on them can be scored; without any there is no list."""
    simulation = simulate("city", 0, Options(poses=2500, loop_rate=1.0, wrong_loop_rate=0.5))
    written = write_simulation(simulation, tmp_path / "drive.mcap")
    assert written.wrong is not None
    listed = written.wrong.read_text().splitlines()[1:]
    assert len(listed) == sum(loop.wrong for loop in simulation.loops) > 0
    assert write_simulation(simulate("square", 0, SHORT), tmp_path / "clean.mcap").wrong is None


@pytest.mark.parametrize(
    ("options", "said"),
    [({"poses": 1}, "poses"), ({"dropout": 1.5}, "dropout"), ({"late_delay": -1}, "late_delay"),
     ({"loop_range": float("nan")}, "loop_range"), ({"period": 0}, "period")],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused_by_name(options: dict, said: str) -> None:
    with pytest.raises(BadConfig, match=f"^{said}: "):
        Options(**options)


def test_an_unknown_scenario_is_refused_with_the_known_ones() -> None:
    with pytest.raises(BadConfig, match="known: square, corridor, city"):
        simulate("moon")


def test_the_bag_in_the_repository_is_what_its_readme_says() -> None:
    """The same messages as the command there makes; poses agree beyond what CPUs may differ in."""
    bags = Path(__file__).parents[2] / "bags"
    simulation = simulate("warehouse", 1)
    with open_bag(bags / "warehouse.mcap") as bag:
        stored = [(r.topic, r.type, r.log_time, len(r.data)) for r in bag.records()]
    assert stored == [(r.topic, r.type, r.log_time, len(r.data)) for r in simulation.records]
    truth = np.loadtxt(bags / "warehouse.truth.tum", usecols=range(1, 8))
    np.testing.assert_allclose(truth, simulation.sevens, atol=1e-9)
    settings = yaml.safe_load((bags / "warehouse.yaml").read_text())
    assert config_from(settings) == config_from(simulation.settings)
