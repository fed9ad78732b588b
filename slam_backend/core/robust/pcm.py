"""Pairwise consistency maximization: of all loops, the largest set of which every two agree (Mangelson et al., ICRA 2018).

Two loops agree when the cycle over both and the odometry between their ends closes, to within the chi-square of the noise
on it. Whether two agree never changes, so each new loop is compared once with all earlier ones; which clique is the largest
can change, and then loops leave the graph and others enter it. The odometry's covariance is multiplied by
`gate.odometry_scale`, as everywhere. It has no say about a loop alone: where most are wrong and none is true, the largest
clique is one of wrong ones.
"""

from dataclasses import dataclass

import numpy as np

from ..config import Config
from ..geometry import inverse_of, matrix_of, quaternion_of
from ..graph import Decision, Delta, Estimate, Factor, Verdict
from ..measurement import Array
from .chi2 import chi2_quantile
from .clique import LargestClique
from .paths import Path, Paths
from .stage import Judged, judged

NAMED = 20  # loops that a verdict names
AXES = {
    "2d": [3, 4, 2],
    "3d": [0, 1, 2, 3, 4, 5],
}  # of a tangent of six, rotation first, in the space's order


class Pcm:
    kinds = frozenset({"loop"})

    def __init__(self, config: Config, paths: Paths) -> None:
        self._config, self._paths = config.pcm, paths
        self._threshold = chi2_quantile(config.pcm.probability, paths.space.dimension)
        self._cycles = Cycles(paths, config.gate.odometry_scale)
        self._clique = LargestClique(config.pcm.steps)
        self._loops: list[Factor] = []
        self._in: frozenset[int] = frozenset()  # what was let in, by number
        self._fresh: list[int] = []

    def admit(self, proposed: Delta, estimate: Estimate) -> Judged:  # noqa: ARG002  # odometry and loops say enough
        """Nothing yet: the review that follows has the largest clique."""
        decisions = []
        for loop in proposed.add:
            distances = self._cycles.add(loop)
            if distances is None:
                decisions.append(
                    judged(
                        "pcm", loop, "refused", "unconnected", "no odometry reaches both its ends", None, None
                    )
                )
                continue
            agree = np.flatnonzero(distances <= self._threshold).tolist()
            self._fresh.append(self._clique.add(sum(1 << other for other in agree)))
            self._loops.append(loop)
        return Delta(remove=proposed.remove), tuple(decisions)

    def review(self, estimate: Estimate) -> Judged:  # noqa: ARG002
        fresh, self._fresh = self._fresh, []
        if not fresh:
            return Delta(), ()
        clique = self._clique.members
        now = clique if len(clique) >= self._config.smallest else frozenset()
        before, self._in = self._in, now
        enter, leave = sorted(now - before), sorted(before - now)
        old = set(fresh)
        decisions = [self._told(n, "accepted" if n in old else "restored") for n in enter]
        decisions += [self._told(n, "removed") for n in leave]
        decisions += [self._told(n, "probation") for n in fresh if n not in now]
        gone = tuple(self._loops[n].id for n in leave if self._loops[n].id in self._paths.factors)
        return Delta(tuple(self._loops[n] for n in enter), gone), tuple(decisions)

    def _told(self, n: int, verdict: Verdict) -> Decision:
        members = self._clique.members
        with_it = sum(1 for other in members if self._clique.neighbours(n) >> other & 1)
        others = len(members - {n})
        agrees = f"agrees with {with_it} of the {others} others in the largest set that agrees"
        if others < self._config.smallest - 1:
            agrees += f"; {self._config.smallest} are needed"
        more: dict[str, object] = {} if self._clique.exact else {"exact": False}
        if verdict in ("accepted", "restored"):
            return judged("pcm", self._loops[n], verdict, "clique", agrees, with_it, others, **more)
        if with_it < others:
            more["absent"] = self._absent(n)
        return judged("pcm", self._loops[n], verdict, "outside_clique", agrees, with_it, others, **more)

    def _absent(self, n: int) -> list[str]:
        """The smallest set of the members without which it agrees with all others of them; some, where they are many."""
        against = [m for m in sorted(self._clique.members) if not self._clique.neighbours(n) >> m & 1]
        return [self._loops[m].id for m in against[:NAMED]]


@dataclass(slots=True)
class Rows:
    """What the cycles need of N loops, as arrays that grow. chains: (N, 2); a, b: (N, 4, 4) ends in the frame of their chains;
    sum_a, sum_b, noise: (N, d, d) odometry from the chain's origin, carried to it; of the loop, at the tangent of b.
    """

    chains: Array
    a: Array
    b: Array
    z: Array
    sum_a: Array
    sum_b: Array
    noise: Array


class Cycles:
    """How well each two loops close their cycle."""

    def __init__(self, paths: Paths, scale: float) -> None:
        self._paths, self._scale = paths, scale
        self._axes = AXES[paths.space.name]
        d = paths.space.dimension
        self._rows = Rows(
            np.zeros((64, 2)), *(np.zeros((64, 4, 4)) for _ in "abz"), *(np.zeros((64, d, d)) for _ in "abz")
        )
        self._count = 0

    def add(self, loop: Factor) -> Array | None:
        """(N,) squared Mahalanobis distances of its cycles with the N loops before it; infinite where no odometry closes
        one. None if no odometry reaches it.
        """
        (p, first), (q, second) = (self._paths.from_origin(key) or (-1, None) for key in loop.keys)
        if first is None or second is None:
            return None
        leap = self._paths.path_of(loop)
        if (p, first.meters) > (
            q,
            second.meters,
        ):  # the earlier end first, so that odometry between ends is short
            p, q, first, second, leap = q, p, second, first, leap.inverse()
        n = self._count
        self._write(n, (p, q), first, second, leap)
        return self._distances(n)

    def _write(self, n: int, chains: tuple[int, int], first: Path, second: Path, leap: Path) -> None:
        rows = self._rows
        if n == len(rows.chains):
            grown = (
                np.concatenate([getattr(rows, name), np.zeros_like(getattr(rows, name))])
                for name in Rows.__slots__
            )
            self._rows = rows = Rows(*grown)
        space = self._paths.space
        rows.chains[n] = chains
        for name, path in (("a", first), ("b", second)):
            adjoint = path.pose.AdjointMap()
            getattr(rows, name)[n] = matrix_of(space.seven(path.pose))
            getattr(rows, f"sum_{name}")[n] = self._scale * adjoint @ path.odometry @ adjoint.T
        rows.z[n], rows.noise[n] = matrix_of(space.seven(leap.pose)), leap.loops
        self._count = n + 1

    def _distances(self, n: int) -> Array:
        """Of loop n against those before it: a_n -> a_m, over m, b_m -> b_n, against n itself."""
        r, others = self._rows, slice(0, n)
        here = inverse_of(r.b[others]) @ r.b[n]  # b_m to b_n
        across = r.z[others] @ here  # a_m to b_n
        error = inverse_of(inverse_of(r.a[n]) @ r.a[others] @ across) @ r.z[n]
        into = self._adjoint(inverse_of(here))
        noise = r.noise[n] + into @ r.noise[others] @ np.swapaxes(into, 1, 2)
        noise += self._odometry(r.sum_b[others] - r.sum_b[n], inverse_of(r.b[n])[None])
        noise += self._odometry(r.sum_a[others] - r.sum_a[n], inverse_of(across) @ inverse_of(r.a[others]))
        turned = quaternion_of(error[:, :3, :3])
        sine = np.linalg.norm(turned[:, :3], axis=1)
        angle = 2 * np.arctan2(sine, turned[:, 3]) / np.where(sine > 0, sine, 1.0)
        away = np.hstack([turned[:, :3] * angle[:, None], error[:, :3, 3]])[:, self._axes]
        distances = np.einsum("ni,ni->n", away, np.linalg.solve(noise, away[:, :, None])[:, :, 0])
        return np.where((r.chains[others] == r.chains[n]).all(axis=1), distances, np.inf)

    def _odometry(self, between: Array, to: Array) -> Array:
        """Differences of two sums (N, d, d), either way round, carried from the chain's origin to where `to` (N, 4, 4) says."""
        sign = np.where(np.trace(between, axis1=1, axis2=2) < 0, -1.0, 1.0)
        adjoint = self._adjoint(to)
        return np.asarray(adjoint @ (sign[:, None, None] * between) @ np.swapaxes(adjoint, 1, 2))

    def _adjoint(self, matrices: Array) -> Array:
        """(N, d, d) adjoints of (N, 4, 4) poses; those of a plane stay in it."""
        rotation, (x, y, z) = matrices[:, :3, :3], np.moveaxis(matrices[:, :3, 3], -1, 0)
        cross = np.zeros_like(rotation)
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
        cross -= np.swapaxes(cross, 1, 2)
        whole = np.zeros((len(matrices), 6, 6))
        whole[:, :3, :3] = whole[:, 3:, 3:] = rotation
        whole[:, 3:, :3] = cross @ rotation
        return np.asarray(whole[:, self._axes][:, :, self._axes])
