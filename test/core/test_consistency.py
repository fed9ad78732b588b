"""Whether a source's noise is what it says: by known answers, and by sources that lie on one axis by a known factor."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from slam_backend.core.config import config_from
from slam_backend.core.consistency import DRAWS, Fit, Ratio, blind_axes
from slam_backend.core.graph import Factor

SIGMAS = np.array([0.05, 0.02, 0.01])
SPREAD = np.diag(SIGMAS**2)
TURNED = np.array([[0.004, 0.0009, 0.0001], [0.0009, 0.001, -0.0002], [0.0001, -0.0002, 0.0004]])


def factor(source, n, made, kind="loop"):
    return Factor(f"{source}/{n}.000000000/0", kind, made, tuple(made.keys()), n * 10**9)


def chain(noise, stated, count=400, seed=1, kernel=False):
    """A ring of poses with two edges between neighbours: one source is exact, the other errs by `noise` and states `stated`."""
    rng = np.random.default_rng(seed)
    exact = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-4))
    model = gtsam.noiseModel.Gaussian.Covariance(stated)
    if kernel:
        model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(50.0), model)
    step, root = gtsam.Pose2(1.0, 0.0, 0.1), np.linalg.cholesky(noise)
    values, factors = gtsam.Values(), []
    values.insert(X(0), gtsam.Pose2())
    factors.append(factor("gauge", 0, gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), exact), "gauge"))
    for n in range(count):
        values.insert(X(n + 1), values.atPose2(X(n)).compose(step))
        factors.append(factor("exact", n, gtsam.BetweenFactorPose2(X(n), X(n + 1), step, exact)))
        measured = step.compose(gtsam.Pose2.Expmap(root @ rng.normal(size=3)))
        factors.append(factor("liar", n, gtsam.BetweenFactorPose2(X(n), X(n + 1), measured, model)))
    return factors, values


def of(told, axis):
    return next(ratio for name, ratio in told.axes.items() if name.startswith(axis))


def test_the_redundancy_of_each_factor_is_the_diagonal_of_the_projection():
    """Against the dense matrix; a sum over many factors within its own sampling error, the whole exactly rows minus unknowns."""
    factors, values = chain(SPREAD, TURNED, count=60)
    fit = Fit(factors, values)
    graph = gtsam.GaussianFactorGraph()
    for each in fit.linear:
        graph.push_back(each)
    matrix, _ = graph.jacobian()
    diagonal = 1 - np.diag(matrix @ np.linalg.solve(matrix.T @ matrix, matrix.T))
    expected = np.add.reduceat(diagonal, np.cumsum(fit.rows) - fit.rows)
    liar = [n for n, each in enumerate(fit.factors) if each.source == "liar"]
    free = expected[liar].sum()
    assert abs(fit.free[liar].sum() - free) < 4 * np.sqrt(2 * free / DRAWS)
    projected = fit.left - (fit.left @ matrix) @ np.linalg.solve(matrix.T @ matrix, matrix.T)
    np.testing.assert_allclose(projected, fit.left, atol=1e-7)


@pytest.mark.parametrize("stated", [SPREAD, TURNED], ids=["diagonal", "correlated"])
@pytest.mark.parametrize("kernel", [False, True], ids=["plain", "kernel"])
def test_a_source_that_tells_the_truth_is_left_alone(stated, kernel):
    told = Fit(*chain(stated, stated, kernel=kernel)).consistency()["liar"]
    low, high = told.whole.bounds
    assert low < told.whole.value < high
    assert told.advice == ""


@pytest.mark.parametrize("stated", [SPREAD, TURNED], ids=["diagonal", "correlated"])
def test_the_axis_that_lies_is_named_with_what_would_fit(stated):
    """Yaw errs by 4.2 times what is stated, x and y are as they say."""
    scale = np.diag((1.0, 1.0, 4.2))
    told = Fit(*chain(scale @ stated @ scale, stated)).consistency()["liar"]
    assert [axis for axis, ratio in told.axes.items() if ratio.is_off] == ["yaw rad"]
    yaw, sigma = of(told, "yaw"), np.sqrt(stated[2, 2])
    assert yaw.times == pytest.approx(4.2, rel=0.1)
    assert yaw.stated == pytest.approx(sigma)
    assert (
        told.advice
        == f"{yaw.times:.1f}x optimistic in yaw: use {yaw.times * sigma:.2g} rad instead of {sigma:.2g}"
    )
    assert told.as_json()["axes"]["yaw rad"]["suggested"] == pytest.approx(4.2 * sigma, rel=0.1)


def test_a_source_that_is_better_than_it_says_is_told_too():
    told = Fit(*chain(SPREAD / 9, SPREAD)).consistency()["liar"]
    assert told.advice.startswith("3.1x pessimistic in x: use 0.016 m instead of 0.05")


def test_what_nothing_else_measures_is_not_judged():
    factors, values = chain(SPREAD, SPREAD)
    alone = [each for each in factors if each.source in ("gauge", "exact")]
    told = Fit(alone, values).consistency()["exact"]
    assert told.whole.value is None
    assert told.advice == ""
    assert "ratio" not in told.as_json()


@pytest.mark.parametrize("loose", [1, 3])
def test_what_the_factors_do_not_determine_is_not_judged(loose):
    """Without its gauge, or with poses that nothing holds: no number that is not one, and none beyond what there is."""
    factors, values = chain(SPREAD, SPREAD, count=5)
    told = Fit(factors[loose:], values).consistency()
    for source, rows in (("exact", 15), ("liar", 15)):
        assert 0 <= told[source].whole.free <= 2 * rows
        assert told[source].advice == ""


def test_what_is_held_counts_as_known():
    """Held poses check an edge between them wholly: as many degrees of freedom as rows."""
    factors, values = chain(SPREAD, SPREAD, count=50)
    liar = [each for each in factors if each.source == "liar"]
    fit = Fit(liar, values, free=lambda _: False)
    assert fit.free.sum() == pytest.approx(150, abs=4 * np.sqrt(2 * 150 / DRAWS))
    assert fit.left.std() == pytest.approx(1.0, abs=0.1)


def test_rows_that_measure_nothing_do_not_count():
    """x and y of a height are there only because the factor has them."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    wide = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e6, 1e6, 0.1]))
    made = [gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))]
    made += [gtsam.PoseTranslationPrior3D(X(0), np.zeros(3), wide)] * 200
    told = Fit([factor("floor", n, each, "floor") for n, each in enumerate(made)], values).consistency()[
        "floor"
    ]
    assert of(told, "z").free == pytest.approx(200, rel=0.2)
    assert of(told, "x").free < 10


def test_landmarks_are_judged_by_bearing_and_range():
    rng = np.random.default_rng(3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.1]))
    values, factors = gtsam.Values(), []
    values.insert(X(0), gtsam.Pose2())
    values.insert(L(0), np.array([5.0, 3.0]))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
    factors.append(factor("gauge", 0, gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), tight), "gauge"))
    for n in range(300):
        bearing = gtsam.Rot2(np.arctan2(3, 5) + rng.normal(0, 0.01))
        made = gtsam.BearingRangeFactor2D(X(0), L(0), bearing, np.hypot(5, 3) + rng.normal(0, 0.3), noise)
        factors.append(factor("trees", n, made, "landmark"))
    assert (
        Fit(factors, values).consistency()["trees"].advice.startswith("2.9x optimistic in range: use 0.29 m")
    )


def test_planar_wheels_are_not_judged_on_what_they_do_not_measure():
    sources = {"lidar": {"kind": "odometry"}, "wheels": {"kind": "odometry", "planar": True}}
    config = config_from({"sources": list(sources), **sources})
    assert set(blind_axes(config)) == {("wheels", axis) for axis in ("roll", "pitch", "z")}
    told = Fit(*chain(SPREAD, SPREAD)).consistency([("liar", "x")])["liar"]
    assert list(told.axes) == ["y m", "yaw rad"]


def test_little_evidence_is_no_verdict():
    assert Ratio(100.0, 2.0).value is None
    assert not Ratio(12.0, 5.0).is_off
    assert Ratio(1200.0, 500.0).is_off
    assert not Ratio(120_000.0, 100_000.0).is_off  # certain, and of no importance


def test_fixes_are_judged_by_position():
    """Their noise is stated for the place of an antenna alone, on a pose, with a lever arm."""
    rng = np.random.default_rng(4)
    values, factors = gtsam.Values(), []
    values.insert(X(0), gtsam.Pose2(3.0, 2.0, 0.7))
    root = np.zeros((3, 3))
    root[:2] = np.array([[1.0, 0.0, -0.3], [0.0, 1.0, 0.5]]) / 0.2  # antenna 0.5 m ahead, 0.3 m to the left
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
    for n in range(300):
        shift = gtsam.Pose2(*rng.normal(0, 0.5, 2), 0.0)
        factors.append(
            factor("gps", n, gtsam.PriorFactorPose2(X(0), values.atPose2(X(0)).compose(shift), noise), "gnss")
        )
    compass = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e3, 1e3, 0.001]))
    factors.append(factor("compass", 0, gtsam.PriorFactorPose2(X(0), values.atPose2(X(0)), compass), "pose"))
    told = Fit(factors, values).consistency()["gps"]
    assert list(told.axes) == ["position m"]
    assert told.axes["position m"].stated == pytest.approx(0.2)
    assert told.axes["position m"].times == pytest.approx(2.5, rel=0.1)
