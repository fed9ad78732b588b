"""What a run keeps of its factors gives the covariances that the factors themselves give."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from slam_backend.core.consistency import Fit
from slam_backend.core.errors import BadFile, SolverFailure
from slam_backend.core.graph import Factor, is_pose
from slam_backend.io.linearized import Linearized, write_linearized


def factor(n: int, kind: str, made: gtsam.NonlinearFactor) -> Factor:
    return Factor(f"{kind}/{n}", kind, made, tuple(made.keys()), 0)


def inertial() -> tuple[list[Factor], gtsam.Values]:
    """Two keyframes joined by a factor of six variables, a robust edge, and an absolute pose."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    params.setAccelerometerCovariance(np.eye(3) * 1e-2)
    params.setGyroscopeCovariance(np.eye(3) * 1e-4)
    params.setIntegrationCovariance(np.eye(3) * 1e-6)
    measured = gtsam.PreintegratedCombinedMeasurements(params)
    for _ in range(50):
        measured.integrateMeasurement(np.array([0.3, 0.1, 9.81]), np.array([0.0, 0.1, 0.2]), 0.02)
    noise = gtsam.noiseModel.Isotropic.Sigma
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise(6, 0.01))
    values = gtsam.Values()
    for k, pose in enumerate((gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.Rz(0.2), np.array([0.5, 0.1, 0.2])))):
        values.insert(X(k), pose)
        values.insert(V(k), np.array([0.1 * k, 0.0, 0.0]))
        values.insert(B(k), gtsam.imuBias.ConstantBias())
    made = [
        gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measured),
        gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(), robust),
        gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), noise(6, 0.1)),
        gtsam.PriorFactorVector(V(0), np.zeros(3), noise(3, 0.1)),
        gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), noise(6, 0.01)),
    ]
    return [factor(n, "any", each) for n, each in enumerate(made)], values


def test_factors_of_any_size_with_kernels_and_priors_give_gtsams_own_marginals(tmp_path: Path) -> None:
    factors, values = inertial()
    write_linearized(tmp_path / "a.npz", Fit(factors, values), np.arange(2))
    graph = gtsam.NonlinearFactorGraph()
    for each in factors:
        graph.add(each.factor)
    expected, found = gtsam.Marginals(graph, values), Linearized(tmp_path / "a.npz")
    for k in range(2):
        np.testing.assert_allclose(
            found.covariance(k), expected.marginalCovariance(X(k)), rtol=1e-7, atol=1e-12
        )
        assert is_pose(X(k))


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_linearized(tmp_path / f"{name}.npz", Fit(*inertial()), np.arange(2))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_what_the_factors_do_not_determine_is_refused(tmp_path: Path) -> None:
    factors, values = inertial()
    write_linearized(tmp_path / "a.npz", Fit(factors[:1], values), np.arange(2))
    found = Linearized(tmp_path / "a.npz")
    for index in (0, 7):
        with pytest.raises(SolverFailure, match=f"keyframe {index}"):
            found.covariance(index)


def test_damage_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    whole = tmp_path / "a.npz"
    write_linearized(whole, Fit(*inertial()), np.arange(2))
    data = whole.read_bytes()
    arrays = dict(np.load(whole))
    for n, damaged in enumerate((b"", b"no zip", data[:200], data[:-30], data[:120] + b"????" + data[124:])):
        path = tmp_path / f"{n}.npz"
        path.write_bytes(damaged)
        with pytest.raises(BadFile, match=f"{n}.npz: is damaged"):
            Linearized(path)
    for name, wrong in (
        ("counts", arrays["counts"][:-1]),
        ("numbers", arrays["numbers"][:-1]),
        ("rows", arrays["rows"] + 1),
    ):
        np.savez(path := tmp_path / f"{name}.npz", **{**arrays, name: wrong})
        with pytest.raises(BadFile, match="damaged"):
            Linearized(path).covariance(0)
    np.savez(path := tmp_path / "kind.npz", **{**arrays, "keys": arrays["keys"].astype(float)})
    with pytest.raises(BadFile, match="damaged"):
        Linearized(path)
    with pytest.raises(BadFile, match="cannot be read: No such file"):
        Linearized(tmp_path / "none.npz")


def test_the_residuals_are_those_of_the_factors(tmp_path: Path) -> None:
    factors, values = inertial()
    write_linearized(tmp_path / "a.npz", Fit(factors, values), np.arange(2))
    found = Linearized(tmp_path / "a.npz")
    assert found.ids.tolist() == [each.id for each in factors]
    assert found.keys == [list(each.keys) for each in factors]
    assert found.rows.tolist() == [15, 6, 6, 3, 6]
    plain = [2 * each.factor.error(values) for each in factors]
    np.testing.assert_allclose(np.delete(found.chi_squares, 1), np.delete(plain, 1), rtol=1e-9, atol=1e-9)
    distance = (0.5**2 + 0.1**2 + 0.2**2 + 0.2**2) / 0.01**2  # of the edge that a kernel of Cauchy weakens
    np.testing.assert_allclose(found.chi_squares[1], distance / (1 + distance), rtol=0.05)
