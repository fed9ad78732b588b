"""Doubt: a fix that lies where it cannot be is not believed until others agree with it.

Each fix is compared with where the graph expects its antenna: the innovation and its chi-square (NIS). One that is too far off is kept
aside. The next one that fits shows it to be alone, and wrong. But fixes that keep coming and agree with each other, given the motion
between them, are believed against the odometry: so it must be after an outage longer than the odometry is good for. Whether they
agree is judged as if all that had been expected of them might be off by one motion, however far: one after the other, each by its
innovation given those before it.

Where an IMU alone drives, all are believed: it is good for seconds, and with noise that is stated too small good fixes look wrong,
are kept out, and nothing holds it any more. There a kernel of the source serves.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np

from ..config import Config, GnssSource, ImuSource
from ..errors import SolverFailure
from ..graph import Decision, Delta, Estimate, Factor, Verdict, is_pose
from ..measurement import SECOND, Array
from .chi2 import chi2_quantile
from .kernels import without_kernel
from .paths import Paths
from .stage import Judged

ASTRAY, TURNED = 1e3, 0.5  # m and rad: by how much what is expected may be off
MOST = 100  # doubted fixes of one source that are remembered


class Doubt:
    kinds = frozenset({"gnss"})

    def __init__(self, config: Config, paths: Paths) -> None:
        self._sources = {n: s for n, s in config.sources.items() if isinstance(s, GnssSource)}
        self._paths, self._axes = paths, paths.space.point_dimension
        driver = config.sources.get(config.driver or "")
        self._by_imu = isinstance(driver, ImuSource)
        self._doubted: dict[str, list[Factor]] = {name: [] for name in self._sources}

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:
        kept: list[Factor] = []
        decisions: list[Decision] = []
        for fix in proposed.add:
            doubted, settings = self._doubted[fix.source], self._sources[fix.source]
            limit = chi2_quantile(settings.probability, self._axes)
            nis = float(self._innovations([fix], estimate)[0])
            if not nis > limit or self._by_imu:
                decisions += [_decision(each, "refused", "alone", None, None) for each in doubted]
                doubted.clear()
                kept.append(fix)
                decisions.append(_decision(fix, "accepted", "expected", nis, limit))
                continue
            doubted.append(fix)
            decisions.append(_decision(fix, "probation", "unexpected", nis, limit))
            if agreed := self._agreed(doubted, settings, limit, estimate):
                decisions += [_decision(each, "accepted", "agreeing", None, None) for each in agreed]
                ids = {each.id for each in agreed}
                decisions += [
                    _decision(each, "refused", "alone", None, None) for each in doubted if each.id not in ids
                ]
                doubted.clear()
                kept += agreed
            elif len(doubted) > MOST:
                decisions.append(_decision(doubted.pop(0), "refused", "alone", None, None))
        return Delta(tuple(kept), proposed.remove, proposed.values), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:  # noqa: ARG002
        """At the end nothing will come that could agree."""
        if not self._paths.ended:
            return Delta(), ()
        left = [each for doubted in self._doubted.values() for each in doubted]
        for doubted in self._doubted.values():
            doubted.clear()
        return Delta(), tuple(_decision(each, "refused", "alone", None, None) for each in left)

    def _agreed(
        self, doubted: Sequence[Factor], settings: GnssSource, limit: float, estimate: Estimate
    ) -> list[Factor]:
        """The newest of them, as few as are enough, if they agree with each other; else none."""
        since = doubted[-1].stamp - settings.agreeing_for * SECOND
        last = [each for each in doubted if each.stamp > since]
        last = list(doubted[-max(len(last) + 1, settings.agreeing) :])
        if len(last) < settings.agreeing or last[0].stamp > since:
            return []
        return [] if (self._innovations(last, estimate, astray=True)[1:] > limit).any() else last

    def _innovations(self, fixes: Sequence[Factor], estimate: Estimate, astray: bool = False) -> Array:
        """(N,) chi-square of each innovation given those before it; NaN where that cannot be told. astray: all the poses may be
        off together.

        From the Cholesky factor of their joint covariance: its rows whiten one innovation after the other.
        """
        keys = list(dict.fromkeys(key for fix in fixes for key in fix.keys))
        try:
            covariance = estimate.covariance(keys)
        except SolverFailure:
            return np.full(len(fixes), np.nan)
        size = len(covariance) // len(keys)
        if astray:
            covariance = covariance + self._together(keys, estimate)
        jacobian = np.zeros((self._axes * len(fixes), len(covariance)))
        error = np.zeros(self._axes * len(fixes))
        for n, fix in enumerate(fixes):
            rows = slice(n * self._axes, (n + 1) * self._axes)
            linear = _linearized(fix.factor, estimate)
            error[rows] = linear.error[: self._axes]
            for column, key in enumerate(linear.keys):
                at = keys.index(key) * size
                jacobian[rows, at : at + size] = linear.jacobian[
                    : self._axes, column * size : (column + 1) * size
                ]
        joint = jacobian @ covariance @ jacobian.T + np.eye(len(error))
        white = np.linalg.solve(np.linalg.cholesky(joint), error)
        return np.asarray((white.reshape(-1, self._axes) ** 2).sum(axis=1))

    def _together(self, keys: Sequence[int], estimate: Estimate) -> Array:
        """Covariance of poses, at their tangents, that may all be moved, and turned about the vertical through the first, as one."""
        space = self._paths.space
        poses = {key: estimate.pose(key) for key in keys if is_pose(key)}
        center = next(iter(poses.values())).translation()
        middle = space.rigid(np.eye(self._axes), center)
        sigmas = np.sqrt(np.diag(space.diagonal(TURNED**2, ASTRAY**2))).copy()
        if space.name == "3d":
            sigmas[:2] = 0.0
        still = np.zeros((space.dimension,) * 2)
        rows = []
        for key in keys:
            moved = poses[key].inverse().compose(middle).AdjointMap() if key in poses else still
            rows.append(moved * sigmas)
        together = np.vstack(rows)
        return np.asarray(together @ together.T)


class _Linear(NamedTuple):
    keys: list[int]
    jacobian: Array
    error: Array


def _linearized(factor: Any, estimate: Estimate) -> _Linear:
    """Of a factor on poses, whitened, without its kernel."""
    plain = factor.cloneWithNewNoiseModel(without_kernel(factor.noiseModel()))
    keys, values = list(map(int, factor.keys())), gtsam.Values()
    for key in keys:
        values.insert(key, estimate.pose(key))
    jacobian, error = plain.linearize(values).jacobian()
    return _Linear(keys, np.asarray(jacobian), np.asarray(error))


_WORDS = {
    "expected": "where it is expected",
    "unexpected": "not where it is expected; others that agree with it would make it believed",
    "agreeing": "it and those after it agree with each other: believed, whatever was expected",
    "alone": "no other fix agreed with it",
}


def _decision(
    fix: Factor, verdict: Verdict, reason: str, statistic: float | None, threshold: float | None
) -> Decision:
    return Decision(
        fix.stamp, fix.id, fix.source, verdict, "doubt", reason, _WORDS[reason], statistic, threshold
    )
