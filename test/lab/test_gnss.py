"""Simulated fixes: what they say is true with their noise, and a run that uses them is as wrong as it says."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import config_from
from slam_backend.core.geometry import matrix_of
from slam_backend.core.graph import DATUM, EARTH
from slam_backend.core.measurement import SECOND
from slam_backend.core.robust.chi2 import chi2_quantile
from slam_backend.core.sensors.gnss import DECODERS, Fix, enu
from slam_backend.core.space import SPACES
from slam_backend.io.bags import open_bag
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.lab.sensing import ORIGIN, arm_of, on_earth
from slam_backend.lab.simulate import Options, simulate, write_simulation

ALONE = Options(
    poses=160,
    loop_rate=0.0,
    landmarks=0,
    gnss_every=4,
    gnss_sigma=0.4,
    gnss_outage_start=8.0,
    gnss_outage=3.0,
)
WORLDS = {"2d": "city", "3d": "spiral"}


def test_fixes_are_the_antenna_on_the_earth_with_the_noise_they_state():
    made = simulate("spiral", 5, replace(ALONE, poses=8000, gnss_outage=0.0))
    fixes = [sent.content for sent in made.sent if isinstance(sent.content, Fix)]
    truth = on_earth(ALONE) @ matrix_of(made.sevens[::4])
    expected = truth[:, :3, :3] @ arm_of(ALONE) + truth[:, :3, 3]
    errors = (enu(np.array([fix.place for fix in fixes]), ORIGIN) - expected) / ALONE.gnss_sigma
    assert abs(errors.std() - 1) < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 0.1


def test_there_are_no_fixes_in_the_outage_and_the_rest_is_as_without_them():
    with_fixes, without = simulate("city", 2, ALONE), simulate("city", 2, replace(ALONE, gnss_every=0))
    seconds = [
        (sent.content.stamp - with_fixes.stamps[0]) / SECOND
        for sent in with_fixes.sent
        if sent.topic == "/fix"
    ]
    assert min(seconds) == 0
    assert not [s for s in seconds if 8.0 <= s < 11.0]
    odometry = [
        [s.content.pose.tolist() for s in made.sent if s.topic == "/odom"] for made in (with_fixes, without)
    ]
    assert odometry[0] == odometry[1]
    assert "gps" not in without.settings["sources"]


def test_the_bag_says_what_the_simulation_says_and_replays_onto_the_earth(tmp_path):
    made = simulate("city", 1, ALONE)
    written = write_simulation(made, tmp_path / "drive.mcap")
    with open_bag(written.bag) as bag:
        record = next(bag.records({"/fix"}))
        told = DECODERS[record.type](bag.typestore.deserialize_cdr(record.data, record.type), "gps")
    first = next(sent.content for sent in made.sent if sent.topic == "/fix")
    assert (told.stamp, told.frame) == (first.stamp, first.frame)
    np.testing.assert_array_equal(told.place, first.place)
    np.testing.assert_array_equal(told.covariance, first.covariance)
    summary = replay(written.bag, load_config(written.config)).result.summary
    assert abs(summary["earth"]["yaw"] - ALONE.gnss_yaw) < 0.3
    assert summary["earth"]["away"]["used"]["horizontal"] < 3 * ALONE.gnss_sigma


def nees(space, seed) -> list[float]:
    """Of the first, the middle and the last keyframe, on the earth."""
    made = simulate(WORLDS[space], seed, ALONE)
    settings = {**made.settings, "earth": {"origin": ORIGIN}}
    backend = Backend(config_from(settings))
    for item in made.measurements:
        backend.add(item)
    backend.finish()
    backend.polish()
    assert DATUM in backend.solver.factors
    shape, earth = SPACES[space], backend.estimate.pose(EARTH)
    truth = shape.from_extrinsics((0, 0, 0, 0, 0, ALONE.gnss_yaw))
    found = []
    for keyframe in (backend.timeline.keyframes[k] for k in (0, 80, -1)):
        row = int(np.searchsorted(made.stamps, keyframe.stamp))
        true = earth.compose(truth).compose(shape.pose(made.sevens[row].tolist()))
        error = shape.logmap(backend.estimate.pose(keyframe.pose).between(true))
        found.append(float(error @ np.linalg.solve(backend.estimate.covariance([keyframe.pose]), error)))
    return found


@pytest.mark.parametrize("space", ["2d", "3d"])
@pytest.mark.parametrize("runs", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_it_is_as_wrong_as_it_says(space, runs):
    """The sum of squared normalized errors of each of three keyframes, over seeded drives, within 99.9 % of chi-square."""
    total = np.sum([nees(space, seed) for seed in range(runs)], axis=0)
    dof = runs * SPACES[space].dimension
    assert (chi2_quantile(0.0005, dof) < total).all()
    assert (total < chi2_quantile(0.9995, dof)).all()
