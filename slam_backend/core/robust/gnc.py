"""Graduated non-convexity, aside: all loops in one batch problem, the wrong ones found with the estimate (Yang et al., RA-L 2020).

See solvers/gnc.py, which `solve --robust gnc` uses as well. Between two landings loops wait, so it is no strategy for
a robot that needs its loop at once. One step is one weighting, a few iterations of the whole graph.
"""

from collections.abc import Sequence

import gtsam

from ..config import Config
from ..graph import Factor
from .aside import Aside, Judgment, Opinion
from .paths import Paths


class Gnc(Aside):
    def __init__(self, config: Config, paths: Paths) -> None:
        super().__init__("gnc", paths, judged, config.gnc.every, config.gnc.lag)


def judged(others: Sequence[Factor], loops: Sequence[Factor], values: gtsam.Values) -> Judgment:
    from ..solvers.gnc import KEPT, Graduation  # which takes its chi-square from here

    graduation = Graduation([*others, *loops], values)
    while not graduation.advance():
        yield
    return {
        loop.id: Opinion(
            weight >= KEPT, "weight", f"its weight in the graduated problem is {weight:.3g}, its cost {cost:.3g}", weight, KEPT
        )
        for loop, weight, cost in zip(graduation.loops, graduation.weights.tolist(), graduation.costs().tolist(), strict=True)
    }  # fmt: skip
