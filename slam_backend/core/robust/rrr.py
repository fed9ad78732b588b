"""Realizing, reversing, recovering: loops in clusters, which must agree within and between (Latif, Cadena & Neira, IJRR 2013).

Within: a cluster of loops beside each other is solved with the odometry between its ends. If the whole passes its chi-square,
loops that do not pass theirs are left out of it; if it does not, the cluster goes. Between: what is good is solved with all
candidates; as long as that does not pass, the cluster that disagrees most goes. Clusters come in as long as any do.

It judges aside, all loops each time. The odometry's covariance is multiplied by `gate.odometry_scale`, as everywhere.
"""

from collections.abc import Generator, Iterable, Sequence

import gtsam
import numpy as np

from ..config import Config
from ..graph import Factor
from ..solvers.descent import Descent, Options
from ..solvers.gauges import gauges, layout
from .aside import Aside, Judgment, Opinion
from .chi2 import chi2_quantile
from .kernels import without_kernel
from .paths import Paths

ROUGH = Options(iterations=10, relative=1e-3)  # a verdict needs no digits
CONFIDENCE = 0.95  # of every chi-square test

Cluster = tuple[Factor, ...]
Step = Generator[None, None, dict[str, float]]  # chi2 by id


class Rrr(Aside):
    def __init__(self, config: Config, paths: Paths) -> None:
        self._scale, self._gap = config.gate.odometry_scale, config.rrr.gap
        self._within: dict[
            frozenset[str], Cluster
        ] = {}  # what is left of a cluster; it depends on nothing else
        super().__init__("rrr", paths, self._judged, config.rrr.every, config.rrr.lag)

    def _judged(self, others: Sequence[Factor], loops: Sequence[Factor], values: gtsam.Values) -> Judgment:
        problem = Problem([self._scaled(factor) for factor in others], values, self._paths)
        clusters: list[Cluster] = []
        reasons: dict[str, str] = {}
        for cluster in self._clusters(loops):
            ids = frozenset(loop.id for loop in cluster)
            if ids not in self._within:
                self._within[ids] = yield from problem.agreeing(cluster)
            left = self._within[ids]
            reasons |= dict.fromkeys(ids - {loop.id for loop in left}, "within")
            clusters += [left] if left else []
        good = yield from problem.together(clusters)
        kept = {loop.id for cluster in good for loop in cluster}
        limit = problem.limit(1)
        chi2 = yield from problem.solved([loop for cluster in good for loop in cluster])
        return {
            loop.id: Opinion(
                loop.id in kept, "cluster" if loop.id in kept else reasons.get(loop.id, "between"),
                _words(loop.id in kept, reasons.get(loop.id)), chi2.get(loop.id, problem.now(loop)), limit,
            )
            for loop in loops
        }  # fmt: skip

    def _clusters(self, loops: Sequence[Factor]) -> list[Cluster]:
        """Loops in the order in which they came, each with the last before it whose ends are both within the gap."""
        clusters: list[list[Factor]] = []
        for loop in loops:
            home = next((c for c in reversed(clusters) if self._beside(c[-1], loop)), None)
            if home is None:
                clusters.append([loop])
            else:
                home.append(loop)
        return [tuple(cluster) for cluster in clusters]

    def _beside(self, one: Factor, other: Factor) -> bool:
        (a, b), (c, d) = one.keys, other.keys
        return any(self._near(a, e) and self._near(b, f) for e, f in ((c, d), (d, c)))

    def _near(self, a: int, b: int) -> bool:
        path = self._paths.along(a, b)
        return path is not None and path.meters <= self._gap

    def _scaled(self, factor: Factor) -> Factor:
        if factor.kind != "motion":
            return factor
        root = np.asarray(without_kernel(factor.factor.noiseModel()).R()) / self._scale**0.5
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
        made = self._paths.space.between(*factor.keys, factor.factor.measured(), noise)
        return Factor(factor.id, factor.kind, made, factor.keys, factor.stamp, factor.stamps)


class Problem:
    """Odometry, and whichever loops are asked about. Solutions are generators: a step is one of them."""

    def __init__(self, others: Sequence[Factor], values: gtsam.Values, paths: Paths) -> None:
        self._others, self._start, self._paths = others, values, paths
        self._values = values  # the last solution of all: the next one is near

    def limit(self, loops: int) -> float:
        return chi2_quantile(CONFIDENCE, loops * self._paths.space.dimension)

    def now(self, loop: Factor) -> float:
        """chi2 of a loop at the estimate."""
        return 2 * float(loop.factor.error(self._values))

    def agreeing(self, cluster: Cluster) -> Generator[None, None, Cluster]:
        """What is left of a cluster that is solved by itself."""
        chi2 = yield from self.solved(cluster, self._between(cluster))
        if sum(chi2.values()) > self.limit(len(cluster)):
            return ()
        return tuple(loop for loop in cluster if chi2[loop.id] <= self.limit(1))

    def together(self, clusters: Sequence[Cluster]) -> Generator[None, None, list[Cluster]]:
        """Good ones grow from what still agrees with them, until nothing more does."""
        good: list[Cluster] = []
        rejected: list[Cluster] = []
        while current := [c for c in clusters if c not in good and c not in rejected]:
            chi2 = yield from self.solved(_flat([*good, *current]))
            candidates = [c for c in current if any(chi2[loop.id] <= self.limit(1) for loop in c)]
            if not candidates:
                break
            joined, gone = yield from self._joined(good, candidates)
            rejected = [*rejected, *gone] if len(joined) == len(good) else list(gone)
            good = joined
        return good

    def _joined(
        self, good: list[Cluster], candidates: list[Cluster]
    ) -> Generator[None, None, tuple[list[Cluster], list[Cluster]]]:
        """The good ones with those candidates that agree with them, and the candidates that went."""
        gone: list[Cluster] = []
        while candidates:
            chi2 = yield from self.solved(_flat([*good, *candidates]))
            if sum(chi2.values()) <= self.limit(len(_flat([*good, *candidates]))):
                return [*good, *candidates], gone
            worst = max(candidates, key=lambda c: sum(chi2[loop.id] for loop in c) / self.limit(len(c)))
            candidates = [c for c in candidates if c is not worst]
            gone.append(worst)
        return good, gone

    def solved(self, loops: Sequence[Factor], others: Sequence[Factor] | None = None) -> Step:
        """chi2 of each loop, and of all odometry under the name of "": with the loops, at their optimum."""
        whole = others is None
        start = self._values if whole else self._start
        factors = [*(self._others if others is None else others), *loops]
        found = layout(factors, start)
        touched = found.touched(start)
        held = gauges(factors, found, touched, self._paths.space)
        descent = Descent([*factors, *held], touched, ROUGH)
        descent.run()
        yield
        if whole:
            self._values = gtsam.Values(start)
            self._values.update(descent.values)
        chi2 = {loop.id: 2 * float(loop.factor.error(descent.values)) for loop in loops}
        return chi2 | {"": 2 * descent.cost - sum(chi2.values())}

    def _between(self, cluster: Cluster) -> list[Factor]:
        """Odometry from the first to the last end of a cluster; the rest of it has nothing to say."""
        keys = [key for loop in cluster for key in loop.keys]
        first, last = min(keys), max(keys)
        return [f for f in self._others if f.kind == "motion" and all(first <= key <= last for key in f.keys)]


def _flat(clusters: Iterable[Cluster]) -> list[Factor]:
    return [loop for cluster in clusters for loop in cluster]


def _words(kept: bool, reason: str | None) -> str:
    if kept:
        return "its cluster agrees with itself and with all others that are kept"
    if reason == "within":
        return "its cluster does not agree with itself, or it not with its cluster"
    return "its cluster agrees with itself, not with those that are kept"
