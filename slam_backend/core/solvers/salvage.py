"""What is kept of a graph that cannot be solved any more.

Wrong measurements, each of which could be solved when it came, may together leave no optimum that can be reached from where
they have drawn the estimate. Then a tree is solved first: of what holds each pose, gauges and motion before others. The
other factors come to it again in halves, the oldest first; what cannot be solved with those before it stays out. A part that
something else than a pose held before, say the earth under its fixes, and where not even the tree can be solved every
pose, is held where it was believed to be.
"""

from collections.abc import Callable, Iterable, Sequence

import gtsam
from gtsam.symbol_shorthand import X

from ..graph import Factor, is_pose
from ..robust.kernels import noise_of
from ..space import Space
from ..variables import value_in
from .gauges import layout

TRIALS = 40  # at most; what has not been let in by then stays out
LOOSE = 1.0  # m^2 and rad^2, of a pose that is held where it is
GROUND = int(X(0)) - 1  # no variable has this key

Solve = Callable[[Sequence[Factor], gtsam.Values], gtsam.Values | None]  # the estimate, None if there is none


def salvaged(
    factors: Iterable[Factor], starts: Sequence[gtsam.Values], space: Space, solve: Solve
) -> tuple[list[Factor], gtsam.Values]:
    """Factors that can be solved, and where from. Some may be new, and hold poses where they are.

    starts: values of every variable; first those that are believed.
    """
    believed = starts[0]
    tree, rest = _tree(factors, believed, space)
    for start in starts:
        found = solve(tree, layout(tree, start).touched(start))
        if found is not None:
            return _with_others(tree, rest, found, start, solve)
    held = [_anchor(key, believed, space) for key in believed.keys() if is_pose(key)]  # noqa: SIM118  # no dict
    return held, layout(held, believed).touched(believed)


def _tree(factors: Iterable[Factor], values: gtsam.Values, space: Space) -> tuple[list[Factor], list[Factor]]:
    """Of the factors that hold a whole pose, alone or by another one, those without which one would float; and all others."""
    above = {GROUND: GROUND}

    def root(key: int) -> int:
        while above.setdefault(key, key) != key:
            above[key] = key = above[above[key]]
        return key

    tree, rest = [], []
    for factor in sorted(factors, key=lambda factor: factor.kind not in ("gauge", "motion")):
        poses = [key for key in factor.keys if is_pose(key)]
        if factor.kind == "imu" and not poses:  # holds velocities and biases, on which an IMU's motion hangs
            tree.append(factor)
            continue
        alone = factor.kind == "motion" or 0 < len(poses) == len(factor.keys)
        whole = alone and factor.factor.dim() >= space.dimension
        ends = {root(key) for key in (*poses, GROUND)[:2]} if whole else ()
        if len(ends) == 2:
            above[max(ends)] = min(ends)
            tree.append(factor)
        else:
            rest.append(factor)
    floating = sorted({root(key) for key in above} - {GROUND})
    return tree + [_anchor(key, values, space) for key in floating], rest


def _with_others(
    kept: list[Factor], rest: Sequence[Factor], found: gtsam.Values, start: gtsam.Values, solve: Solve
) -> tuple[list[Factor], gtsam.Values]:
    """With as many of the rest as can be solved with them."""
    halves, trials = [_together(rest)], 0
    while halves and trials < TRIALS:
        groups, trials = halves.pop(), trials + 1
        more = [*kept, *(factor for group in groups for factor in group)]
        values = gtsam.Values(layout(more, start).touched(start))
        values.update(found)
        better = solve(more, values)
        if better is not None:
            kept, found = more, better
        elif len(more) > len(kept) + 1:
            groups = groups if len(groups) > 1 else [[factor] for factor in groups[0]]
            halves += [groups[len(groups) // 2 :], groups[: len(groups) // 2]]
    return kept, found


def _together(factors: Iterable[Factor]) -> list[list[Factor]]:
    """Those of the same landmark in one group: one bearing alone does not say where it is."""
    groups: dict[object, list[Factor]] = {}
    for factor in factors:
        of = next((key for key in factor.keys if not is_pose(key)), factor.id)
        groups.setdefault(of, []).append(factor)
    return list(groups.values())


def _anchor(key: int, values: gtsam.Values, space: Space) -> Factor:
    noise = noise_of(space.diagonal(LOOSE, LOOSE))
    prior = space.prior(key, value_in(space, values, key), noise)
    return Factor(f"gauge/{gtsam.DefaultKeyFormatter(key)}", "gauge", prior, (key,), 0)
