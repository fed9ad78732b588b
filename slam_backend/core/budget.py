"""Bounded cost of landmarks that are seen again and again: beyond a budget, old sightings are summarized, with the price on record.

As long as the poses stay, sightings from several poses cannot be said by fewer factors: what one of them could take over from
another would count the odometry between them twice, and the map would be surer than it may be. So two things are done, and
neither makes anything surer. Sightings from one keyframe are combined into one, which says the same (to first order). If there
are still too many, those go without which the graph as a whole loses least: the entropy that a sighting has taken away is
-1/2 log det(I - A P A'), A its whitened Jacobian, P the joint covariance (Ila, Porta & Andrade-Cetto, TRO 26(1), 2010, who keep
links by it). Not the oldest: those are what closes a loop. It depends on where things are, not on how well they fit, so what
stays is no chosen sample of the noise.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from .config import Config, LandmarkSource
from .errors import SolverFailure
from .graph import Decision, Delta, Estimate, Factor
from .measurement import Array
from .robust.stage import Judged
from .sensors.landmark import PLACED
from .space import Space

AT_ONCE = 100  # sightings of a landmark whose joint covariance is asked for
HELD = 1e-6  # of an eigenvalue of I - A P A': below, a sighting is all that holds something


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A sighting as a point in the frame of its pose, and the information of that."""

    point: Array
    information: Array


class Budget:
    """A robust stage that judges nothing on its way in, and keeps the factors of each landmark below a number."""

    kinds: frozenset[str] = frozenset()

    def __init__(
        self,
        config: Config,
        space: Space,
        factors: Mapping[str, Factor],
        wished: Callable[[], Collection[str]],
    ) -> None:
        """factors: all that are in the graph, by their ids. wished: ids about which a person has decided; these stay as they are."""
        self._most, self._space = config.budget.sightings, space
        self._factors, self._wished = factors, wished
        self._renewed = {
            name
            for name, source in config.sources.items()
            if isinstance(source, LandmarkSource) and source.calibrate
        }
        self._ids: dict[int, list[str]] = defaultdict(list)
        self._over: dict[int, None] = {}  # landmarks with too many, in the order in which they came to that

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # of no kind of factor
        return proposed, ()

    def book(self, delta: Delta) -> None:
        """What the solver has taken."""
        for factor in delta.add:
            if self._most and factor.kind == "landmark" and isinstance(factor.factor, PLACED):
                ids = self._ids[factor.keys[1]]
                ids.append(factor.id)
                if len(ids) > self._most:
                    self._over[factor.keys[1]] = None

    def review(self, estimate: Estimate) -> Judged:
        over, self._over = self._over, {}
        amendment = Delta()
        decisions: list[Decision] = []
        for key in over:
            held = self._held(key)
            if len(held) <= self._most:
                continue
            wished = self._wished()
            old = [f for f in held[: -(self._most // 2) or None] if f.id not in wished][:AT_ONCE]
            change, told = self._combined(old)
            if not change:
                change, told = self._dropped(key, old, len(held), estimate)
            if change and len(held) - len(change.remove) + len(change.add) > self._most:
                self._over[key] = None  # the rest at the next keyframe
            amendment += change
            decisions += told
        return amendment, tuple(decisions)

    def _held(self, key: int) -> list[Factor]:
        """The sightings of a landmark that are in the graph, in the order of their stamps."""
        ids = [id_ for id_ in self._ids[key] if id_ in self._factors and self._factors[id_].keys[1] == key]
        self._ids[key] = ids
        return sorted((self._factors[id_] for id_ in ids), key=lambda factor: factor.stamp)

    # -- from one keyframe -----------------------------------------------------------------------

    def _combined(self, old: Sequence[Factor]) -> Judged:
        """One factor for all that a source has seen of a landmark from one keyframe. A robust kernel judges each by itself, and
        calibration makes each anew: those stay.
        """
        groups: dict[tuple[str, int], list[Factor]] = defaultdict(list)
        for f in old:
            if f.source not in self._renewed and not isinstance(
                f.factor.noiseModel(), gtsam.noiseModel.Robust
            ):
                groups[f.source, f.keys[0]].append(f)
        change = Delta()
        decisions: list[Decision] = []
        for group in groups.values():
            if len(group) > 1:
                whole, chi2 = self._sum(group)
                change += Delta((whole,), tuple(f.id for f in group))
                why = f"stands for {len(group)} sightings from its keyframe"
                of = [f.id for f in group]
                decisions.append(_told(whole, "accepted", "sum", why, of=of, chi2=chi2))
                decisions += [_told(f, "removed", "combined", f"in {whole.id}") for f in group]
        return change, tuple(decisions)

    def _sum(self, group: Sequence[Factor]) -> tuple[Factor, float]:
        """And the chi-square among them, which is no part of the cost any more."""
        seen = [_seen(factor) for factor in group]
        information = np.sum([each.information for each in seen], axis=0)
        point = np.linalg.solve(information, np.sum([each.information @ each.point for each in seen], axis=0))
        chi2 = sum(float((s.point - point) @ s.information @ (s.point - point)) for s in seen)
        value, covariance = self._space.to_polar(point, np.linalg.inv(information))
        newest, (pose, landmark) = group[-1], group[-1].keys
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        count = sum(_count(factor.id) for factor in group)
        id_ = f"{newest.id.partition(':')[0]}:{count}"
        factor = self._space.observe(pose, landmark, value, noise)
        return Factor(id_, "landmark", factor, newest.keys, newest.stamp), chi2

    # -- from several ----------------------------------------------------------------------------

    def _dropped(self, key: int, old: Sequence[Factor], count: int, estimate: Estimate) -> Judged:
        """Without those of the old that say least, down to three quarters of the budget: at most half of the old at once."""
        spare = min(count - max(1, 3 * self._most // 4), len(old) // 2)
        poses = list(dict.fromkeys(factor.keys[0] for factor in old))
        try:
            joint = estimate.covariance([*poses, key]) if spare > 0 else None
        except SolverFailure:
            joint = None
        if joint is None:  # no price can be told: it is tried again with the next sighting
            return Delta(), ()
        rows = [_jacobian(factor, poses, joint, estimate) for factor in old]
        gone, after = thinned(rows, joint, spare)
        d = self._space.point_dimension
        sigma = [float(np.sqrt(np.trace(each[-d:, -d:]))) for each in (joint, after)]
        why = f"one of {len(gone)} of {count} sightings that say least: sigma {sigma[0]:.3g} -> {sigma[1]:.3g} m"
        decisions = [
            _told(old[n], "removed", "dropped", why, loss, sigma=sigma, removed=len(gone), of=count)
            for n, loss in gone.items()
        ]
        return Delta(remove=tuple(old[n].id for n in gone)), tuple(decisions)


def thinned(rows: Sequence[Array], joint: Array, spare: int) -> tuple[dict[int, float], Array]:
    """Up to `spare` rows, greedily those that cost least: number -> nats of entropy; and the covariance without them.

    rows: (m, n) whitened Jacobians of measurements that are in `joint`, (n, n). What is all that holds something is kept.
    """
    gone: dict[int, float] = {}
    for _ in range(spare):
        left = {n: _loss(row, joint) for n, row in enumerate(rows) if n not in gone}
        n = min(left, key=lambda n: (left[n], n))
        if not np.isfinite(left[n]):
            break
        row = rows[n]
        gone[n] = left[n]
        gain = joint @ row.T
        joint = joint + gain @ np.linalg.solve(np.eye(len(row)) - row @ gain, gain.T)
    return gone, joint


def _loss(row: Array, joint: Array) -> float:
    left = np.linalg.eigvalsh(np.eye(len(row)) - row @ joint @ row.T)
    return float(-0.5 * np.log(left).sum()) if left[0] > HELD else np.inf


def _jacobian(factor: Factor, poses: Sequence[int], joint: Array, estimate: Estimate) -> Array:
    """Whitened, kernel and all, over all poses and the landmark, which is last."""
    pose, point = factor.keys
    values = gtsam.Values()
    values.insert(pose, estimate.pose(pose))
    values.insert(point, estimate.point(point))
    own = np.asarray(factor.factor.linearize(values).jacobian()[0])
    d = len(estimate.point(point))
    size = own.shape[1] - d
    at = poses.index(pose) * size
    row = np.zeros((len(own), len(joint)))
    row[:, at : at + size], row[:, -d:] = own[:, :size], own[:, size:]
    return row


def _seen(factor: Factor) -> Seen:
    value = factor.factor.measured()
    bearing, distance = value.bearing(), value.range()
    if hasattr(bearing, "point3"):
        ahead, across = bearing.point3(), bearing.basis()
    else:
        ahead, across = np.array([bearing.c(), bearing.s()]), np.array([[-bearing.s()], [bearing.c()]])
    jacobian = np.column_stack([across * distance, ahead])
    covariance = jacobian @ factor.factor.noiseModel().covariance() @ jacobian.T
    return Seen(ahead * distance, np.linalg.inv(covariance))


def _count(id_: str) -> int:
    """How many sightings a factor stands for."""
    return int(id_.partition(":")[2] or 1)


def _told(
    factor: Factor, verdict: Any, reason: str, detail: str, loss: float | None = None, **basis: Any
) -> Decision:
    landmark = gtsam.DefaultKeyFormatter(factor.keys[1])
    return Decision(
        factor.stamp, factor.id, factor.source, verdict, "budget", reason, detail, loss,
        basis={"landmark": landmark, **basis},
    )  # fmt: skip
