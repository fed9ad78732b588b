"""The filter is an honest rival: right where a filter can be right, consistent, and worse than the smoother where it forgets."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.errors import SolverFailure
from slam_backend.core.geometry import covariance_to_ros
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import frozen
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.solvers import SOLVERS
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.replay import settled_stream
from slam_backend.lab.ekf import BATCH, CLONES, Ekf
from slam_backend.lab.evaluate import evaluate
from slam_backend.lab.simulate import Options, simulate

SMALL = Options(
    sigma_translation_per_meter=0.01,
    sigma_translation_per_radian=0.005,
    sigma_rotation_per_meter=0.001,
    sigma_rotation_per_radian=0.005,
    landmark_sigma=0.05,
)
TINY = {
    name: getattr(SMALL, name) / 100 for name in SMALL.__slots__ if name.startswith(("sigma", "landmark_s"))
}
CHI2_999 = {  # degrees of freedom: the two-sided 99.9 % interval of chi-square
    30: (10.804, 62.162),
    300: (225.886, 387.203),
    600: (492.521, 720.576),
}


def drive(simulation, estimator, extra=(), **sources):
    """A back-end that has seen the whole simulation (and `extra` measurements), and its decisions."""
    settings = {**simulation.settings, **sources}
    settings["sources"] = [*simulation.settings["sources"], *sources]
    config = config_from(settings)
    backend = Backend(config, estimator(config, SPACES[config.space]))
    items = sorted([*simulation.measurements, *extra], key=lambda m: m.stamp)
    decisions, updates = [], []
    for item in settled_stream(items, config):
        if isinstance(item, Decision):
            decisions.append(item)
        else:
            updates += backend.add(item)
    updates += backend.finish()
    backend.polish()
    return backend, [*decisions, *(d for update in updates for d in update.decisions)]


@pytest.mark.parametrize("scenario", ["square", "spiral", "warehouse"])
def test_where_nothing_is_curved_and_nothing_forgotten_it_is_the_smoother(scenario):
    """With noise so small that linearizing once is enough, mean and covariance are those of least squares: the theorem
    that a Kalman filter rests on. With landmarks, loops, a mount, and an absolute pose in the middle.
    """
    simulation = simulate(scenario, 2, replace(SMALL, poses=CLONES, landmarks=12, loop_rate=0.5, **TINY))
    middle = CLONES // 2
    sevens = simulation.sevens[middle] + np.array([30.0, -20.0, 0, 0, 0, 0, 0])
    ros = covariance_to_ros(np.diag([1e-8] * 6), SPACES["3d"].pose(sevens).rotation().matrix())
    fix = AbsolutePose(int(simulation.stamps[middle]), "fix", "", frozen(sevens), frozen(ros.reshape(36)))
    filter_, smoother = (
        drive(simulation, each, [fix], fix={"kind": "pose", "topic": "/fix"})[0]
        for each in (Ekf, SOLVERS["isam2"])
    )
    believed, known = filter_.snapshot(), smoother.snapshot()
    np.testing.assert_allclose(believed.trajectory.sevens, known.trajectory.sevens, atol=1e-5)
    np.testing.assert_allclose(believed.landmarks, known.landmarks, atol=1e-5)
    assert len(known.landmarks) > 3
    last, some = smoother.timeline.newest.pose, smoother.landmark(known.names[0])
    for key in (last, some):
        ours, theirs = filter_.estimate.covariance([key]), smoother.estimate.covariance([key])
        np.testing.assert_allclose(ours, theirs, atol=0.005 * np.abs(theirs).max())


def nees(scenario, seeds, at, options):
    """(seeds, len(at)) normalized error squared of the newest pose; the gauge's own doubt is drawn too."""
    found = np.empty((seeds, len(at)))
    for seed in range(seeds):
        simulation = simulate(scenario, seed, options)
        config = config_from(simulation.settings)
        space = SPACES[config.space]
        backend = Backend(config, Ekf(config, space))
        shift = space.expmap(np.random.default_rng(1000 + seed).standard_normal(space.dimension) * 1e-3)
        for item in settled_stream(simulation.measurements, config):
            for update in backend.add(item):
                if (k := update.keyframe.index) in at:
                    truth = shift.compose(space.pose(simulation.sevens[k].tolist()))
                    error = space.logmap(space.pose(update.pose).between(truth))
                    P = backend.estimate.covariance([update.keyframe.pose])
                    found[seed, at.index(k)] = error @ np.linalg.solve(P, error)
    return found


def test_it_is_as_wrong_as_it_says():
    """Ten drives among landmarks, no loops: the sum of NEES is within the 99.9 % of chi-square at every moment looked at."""
    options = replace(SMALL, poses=131, landmarks=12, loop_rate=0.0)
    sums = nees("square", 10, [40, 70, 100, 130], options).sum(axis=0)
    low, high = CHI2_999[10 * 3]
    assert ((low < sums) & (sums < high)).all(), sums


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "dimension", "landmarks"), [("square", 3, 30), ("warehouse", 3, 70), ("spiral", 6, 60)]
)
def test_it_is_as_wrong_as_it_says_in_a_hundred_drives(scenario, dimension, landmarks):
    options = replace(SMALL, poses=401, landmarks=landmarks, loop_rate=0.0)
    sums = nees(scenario, 100, list(range(50, 401, 50)), options).sum(axis=0)
    low, high = CHI2_999[100 * dimension]
    assert ((low < sums) & (sums < high)).all(), sums


def better(scenario, seeds, options, error):
    """In how many drives the smoother's error is the smaller one."""
    wins = 0
    for seed in range(seeds):
        simulation = simulate(scenario, seed, options)
        filter_, smoother = (
            error(drive(simulation, each)[0], simulation) for each in (Ekf, SOLVERS["isam2"])
        )
        wins += smoother < filter_
    return wins


def apart(backend, simulation):
    """RMS distance to the truth of every keyframe: both begin at the same pose."""
    away = (backend.snapshot().trajectory.sevens - simulation.sevens)[:, :3]
    return np.sqrt(np.mean(np.sum(away**2, axis=1)))


def ate(backend, simulation):
    truth = Trajectory(simulation.stamps, simulation.sevens)
    return evaluate(backend.snapshot().trajectory, truth).ate["rmse"]


def test_with_loops_the_smoother_is_nearer_to_the_truth():
    assert better("square", 10, Options(poses=250, loop_rate=0.2), apart) >= 9


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["square", "spiral", "warehouse"])
def test_with_loops_the_smoother_s_ate_is_better_in_95_of_100_drives(scenario):
    """The warehouse has landmarks too, which close loops for the filter as well."""
    pytest.importorskip("evo", reason="evo is not installed (extra `eval`)")
    assert better(scenario, 100, Options(poses=500, loop_rate=0.5), ate) >= 95


def test_a_loop_within_what_it_holds_is_used_and_one_beyond_is_refused_by_name():
    simulation = simulate("square", 1, Options(poses=400, loop_rate=0.3))
    backend, decisions = drive(simulation, Ekf)
    verdicts = {d.id: d for d in decisions if d.ends is not None}
    assert len(verdicts) == len(simulation.loops) > 10
    period = simulation.stamps[1] - simulation.stamps[0]
    for decision in verdicts.values():
        age = (backend.timeline.at(decision.ends[1]).stamp - decision.ends[0]) // period
        if age < CLONES - 5:  # a loop comes a few keyframes after its end
            assert decision.verdict == "accepted"
        if age > CLONES + BATCH:
            assert (decision.verdict, decision.stage) == ("refused", "solver")
            assert f"newest {CLONES} keyframes" in decision.detail
    assert {d.verdict for d in verdicts.values()} == {"refused"}  # once around the block is 153 poses


def test_the_forgotten_keep_their_pose_and_their_own_covariance():
    simulation = simulate("square", 1, Options(poses=300, loop_rate=0.0))
    backend, _ = drive(simulation, Ekf)
    first, last = (backend.timeline.keyframes[k].pose for k in (10, -1))
    assert np.linalg.eigvalsh(backend.estimate.covariance([first]))[0] > 0
    with pytest.raises(SolverFailure, match="forgotten"):
        backend.estimate.covariance([first, last])
    assert len(backend.snapshot().stamps) == 300


def test_the_command_line_runs_it_and_says_so(tmp_path, capsys):
    assert main(["simulate", "square", "--set", "poses=150", "--out", str(tmp_path / "a.mcap")]) == 0
    replay = ["replay", str(tmp_path / "a.mcap"), "--config", str(tmp_path / "a.yaml"), "--estimator", "ekf"]
    assert main([*replay, "--out", str(tmp_path / "run"), "--json"]) == 0
    assert '"estimator": "ekf"' in capsys.readouterr().out
    assert main([*replay, "--final", "batch"]) == 2
    assert "a filter has no batch" in capsys.readouterr().err
