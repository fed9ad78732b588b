"""Kernels that report their weight: the closed forms equal what they are the closed form of; verdicts follow the estimate."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import S

from slam_backend.core.config import Config
from slam_backend.core.graph import keyframe
from slam_backend.core.robust.max_mixture import null_from
from slam_backend.core.robust.switchable import kernel_of, switch_exact, switch_scaled
from slam_backend.core.space import SPACES

from .conftest import Drive, ends

DISTANCES = np.array([0.0, 0.2, 0.9, 1.0, 1.1, 3.0, 17.0, 400.0])  # chi2
SWITCHES = np.linspace(0.0, 1.0, 100_001)
PRIORS = {"exact": lambda phi, s: phi * (1 - s) ** 2, "dcs": lambda phi, s: phi * (1 - s) * (3 - s)}


@pytest.mark.parametrize("phi", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("form", PRIORS)
def test_the_kernel_is_what_is_left_when_the_switch_is_minimized(form, phi):
    """min over s of s^2 chi2 + P(s), by trying all s; and the switch that is reported is the one that attains it."""
    kernel, switch = kernel_of(phi, form == "dcs"), {"exact": switch_exact, "dcs": switch_scaled}[form]
    for chi2 in DISTANCES:
        costs = SWITCHES**2 * chi2 + PRIORS[form](phi, SWITCHES)
        assert 2 * kernel.loss(np.sqrt(chi2)) == pytest.approx(costs.min(), abs=1e-6)
        assert switch(phi, chi2) == pytest.approx(SWITCHES[costs.argmin()], abs=2e-5)
        assert kernel.weight(np.sqrt(chi2)) == pytest.approx(switch(phi, chi2) ** 2, rel=1e-12)


def test_a_graph_with_explicit_switch_variables_has_the_same_optimum():
    """Three poses, a true and a wrong loop: once with a scalar switch per loop as a variable of its own, once without."""
    phi, space = 1.0, SPACES["2d"]
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    keys = [keyframe(k, 0).pose for k in range(4)]
    step = gtsam.Pose2(1, 0, 0.1)
    loops = [(0, 2, gtsam.Pose2(2.0, 0.22, 0.2)), (0, 3, gtsam.Pose2(1.5, 0.6, 0.5))]
    common, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    common.add(space.prior(keys[0], space.identity, gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
    pose = space.identity
    for a, b in pairwise(keys):
        common.add(space.between(a, b, step, noise))
    for key in keys:
        start.insert(key, pose)
        pose = pose.compose(step)
    explicit, closed = gtsam.NonlinearFactorGraph(common), gtsam.NonlinearFactorGraph(common)
    switched = gtsam.Values(start)
    for n, (i, j, measured) in enumerate(loops):
        explicit.push_back(_switched(keys[i], keys[j], S(n), measured, noise))
        explicit.push_back(
            gtsam.PriorFactorDouble(S(n), 1.0, gtsam.noiseModel.Isotropic.Sigma(1, 1 / np.sqrt(phi)))
        )
        switched.insert(S(n), 1.0)
        robust = gtsam.noiseModel.Robust.Create(kernel_of(phi, scaled=False), noise)
        closed.add(space.between(keys[i], keys[j], measured, robust))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setMaxIterations(500)
    with_switches = gtsam.LevenbergMarquardtOptimizer(explicit, switched, params).optimize()
    without = gtsam.LevenbergMarquardtOptimizer(closed, start, params).optimize()
    assert explicit.error(with_switches) == pytest.approx(closed.error(without), rel=1e-6)
    for key in keys:
        apart = with_switches.atPose2(key).between(without.atPose2(key))
        assert space.size(apart)[0] < 1e-4
    for n, (i, j, measured) in enumerate(loops):
        error = (
            space.logmap(measured.between(without.atPose2(keys[i]).between(without.atPose2(keys[j])))) / 0.1
        )
        assert with_switches.atDouble(S(n)) == pytest.approx(
            switch_exact(phi, float(error @ error)), abs=1e-3
        )
    assert with_switches.atDouble(S(1)) < 0.1 < 0.8 < with_switches.atDouble(S(0))


def _switched(a, b, s, measured, noise):
    """s times the error of a between factor; Python is good enough for four poses."""
    plain = gtsam.BetweenFactorPose2(a, b, measured, noise)

    def error(this, values, jacobians):
        factor = values.atDouble(s)
        residual = plain.unwhitenedError(values)
        if jacobians is not None:
            for n, key in enumerate((a, b)):
                jacobians[n] = factor * _jacobian(plain, values, key)
            jacobians[2] = residual.reshape(-1, 1)
        return factor * residual

    return gtsam.CustomFactor(noise, [a, b, s], error)


def _jacobian(factor, values, key):
    """By central differences."""
    columns = []
    for axis in np.eye(3):
        ends = []
        for sign in (1e-6, -1e-6):
            moved = gtsam.Values(values)
            moved.update(key, values.atPose2(key).retract(sign * axis))
            ends.append(factor.unwhitenedError(moved))
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.column_stack(columns)


@pytest.mark.parametrize("dimension", [3, 6])
def test_a_max_mixture_is_the_larger_of_two_weighed_gaussians(dimension):
    """Against the mixture as the paper writes it, at a scale at which the null hypothesis still has a pull."""
    weight, scale = 0.01, 1e-12
    bound = null_from(weight, scale, dimension)
    kernel = gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create(np.sqrt(bound))
    for chi2 in (0.0, 1.0, 0.99 * bound, 1.01 * bound, 10 * bound):
        own, null = chi2 / 2, scale * chi2 / 2 - np.log(weight) - dimension / 2 * np.log(scale)
        assert kernel.loss(np.sqrt(chi2)) == pytest.approx(min(own, null), rel=1e-9)
        assert kernel.weight(np.sqrt(chi2)) == float(own < null)


@pytest.mark.parametrize("stage", ["switchable", "max_mixture"])
@pytest.mark.parametrize("dimension", ["2d", "3d"])
def test_wrong_loops_enter_and_are_told_to_weigh_little(dimension, stage):
    """Odometry is good enough for the estimate to be near the true ones when they come."""
    drive = Drive(dimension, odometry=0.01)
    true, wrong = drive.true(2, 8), drive.wrong((70, 30), (80, 40), (90, 50))
    ended = drive.run([*true, *wrong], robust=[stage], switchable={"phi": 30.0})
    assert ended.kept == ends([*true, *wrong])
    verdicts = {pair: decision.verdict for pair, decision in ended.last.items()}
    assert {verdicts[pair] for pair in ends(wrong)} == {"probation"}
    assert {verdicts[pair] for pair in ends(true)} <= {"accepted", "restored"}
    assert all(ended.last[pair].statistic < 0.5 for pair in ends(wrong))
    weight = ended.backend.jury.stages[0]._weight  # the same function, at the same estimate
    for basis in (ended.last[pair].basis for pair in ends(wrong)):
        larger = basis["would_pass"]["loop"]
        assert weight(basis["distance"] / larger**2 * (1 - 1e-9)) >= 0.5
        assert weight(basis["distance"] / (0.999 * larger) ** 2) < 0.5


def test_from_a_drifted_estimate_a_kernel_sees_no_loop_at_all():
    """Which is why it is a second line, never the first."""
    drive = Drive("2d", odometry=5.0)
    ended = drive.run(drive.true(2, 8), robust=["switchable"])
    assert {decision.verdict for decision in ended.last.values()} == {"probation"}


@pytest.mark.parametrize("stage", ["switchable", "max_mixture"])
def test_the_kernel_goes_around_the_plain_noise_and_replaces_one_of_the_source(drive, stage):
    ended = drive.run(drive.true(2, 1), robust=[stage], edges={"kind": "relative", "kernel": "huber"})
    (loop,) = [f for f in ended.backend.solver.factors.values() if f.kind == "loop"]
    noise = loop.factor.noiseModel()
    assert (
        type(noise.robust()).__name__ == {"switchable": "DCS", "max_mixture": "TruncatedLeastSquares"}[stage]
    )
    assert not hasattr(noise.noise(), "robust")


def test_the_exact_form_can_be_asked_for(drive):
    ended = drive.run(drive.true(2, 1), robust=["switchable"], switchable={"form": "exact", "phi": 9.0})
    (loop,) = [f for f in ended.backend.solver.factors.values() if f.kind == "loop"]
    kernel = loop.factor.noiseModel().robust()
    assert kernel.weight(3.0) == pytest.approx(0.25)
    assert Config().switchable.form == "dcs"
