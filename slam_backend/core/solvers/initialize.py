"""Where to start: the vertices that a file states, the odometry, or the chordal relaxation; `auto` chooses.

A descent goes wrong where drift has wound the start around: an edge that disagrees with it by nearly half a turn is
corrected the wrong way, and the descent stops in a wrong place or takes its time. So `auto` takes the file's vertices or
the odometry where every edge agrees with them within `WOUND` and `ALONG`. Else they have a few iterations to settle with no
edge wound; if they do not, the chordal relaxation takes over.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import gtsam
import numpy as np

from ..errors import BadConfig, SolverFailure
from ..graph import HOLDING, Factor, Pose, is_pose
from ..measurement import Array
from ..robust.kernels import without_kernel
from ..sensors.placing import Sighting, place
from ..space import Space
from ..variables import is_posed
from .batch import Start
from .chordal import chordal
from .descent import NO_FALL, SETTLED, Descent, Options, Progress, unwatched
from .edges import Edges, edges_of, pose_of_matrix, rotations_of, turns
from .gauges import FIXING, Labels, Layout, connected, gauges, layout, space_of

InitializationName = Literal["auto", "file", "odometry", "chordal"]
WOUND, ALONG = 2.0, 0.5  # rad: of any edge; of an odometry edge, since turns add up along them
UNWOUND = 1.0  # rad: of any edge at the end to which a wound start has led
TRIAL = 8  # iterations


@dataclass(frozen=True, eq=False)
class Ground:
    """What an initialization may use. stated: the values of the file, all or some of them."""

    factors: Sequence[Factor]
    stated: gtsam.Values
    space: Space
    found: Layout

    @cached_property
    def edges(self) -> Edges:
        return edges_of(self.factors, self.found, self.space)

    @cached_property
    def island(self) -> Labels:
        """(N,) the row of the first pose that edges between poses lead to; landmarks may join islands to one part."""
        return connected(len(self.found.keys), self.edges.i, self.edges.j)

    @property
    def roots(self) -> list[int]:
        """The row of the first pose of each island."""
        return [row for row in np.unique(self.island).tolist() if is_pose(self.keys[row])]

    @property
    def states_all(self) -> bool:
        """Whether the file states every pose that the factors touch."""
        return all(self.stated.exists(key) for key in self.keys if is_pose(key))

    @cached_property
    def keys(self) -> list[int]:
        return [int(key) for key in self.found.keys]


def initialize(
    factors: Sequence[Factor],
    stated: gtsam.Values | None = None,
    how: InitializationName = "auto",
    options: Options | None = None,
    progress: Progress = unwatched,
) -> Start:
    """A start for `solve`. BadConfig if `file` is asked for and the file states no vertices."""
    space = space_of(factors)
    stated = gtsam.Values() if stated is None else stated
    ground = Ground(factors, stated, space, layout(factors, stated))
    if how == "auto":
        return _chosen(ground, options or Options(), progress)
    return _from(how, ground)


def cost_of(factors: Sequence[Factor], values: gtsam.Values) -> float:
    """chi2/2, gauges left out."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        if factor.kind not in HOLDING:
            graph.add(factor.factor)
    return float(graph.error(values))


def _chosen(ground: Ground, options: Options, progress: Progress) -> Start:
    tried = []
    for name in ("file", "odometry") if ground.states_all else ("odometry",):
        start = _from(name, ground)
        along, worst = _wound(ground, start.values)
        if along < ALONG and worst < WOUND:
            return replace(start, why=f"no edge disagrees with it by more than {worst:.2g} rad")
        tried.append((cost_of(ground.factors, start.values), start))
    nearest = min(tried, key=lambda pair: pair[0])[1]
    ahead, cost = _advanced(nearest, ground, options, progress)
    if ahead.settled and _wound(ground, ahead.values)[1] < UNWOUND:
        return replace(ahead, why=f"settled within {TRIAL} iterations")
    start = _from("chordal", ground)
    if (of_chordal := cost_of(ground.factors, start.values)) < cost:
        why = f"cost {of_chordal:.6g}, against {cost:.6g} from {nearest.name} after {TRIAL} iterations"
        return replace(start, why=why)
    other, other_cost = _advanced(start, ground, options, progress)
    best, worse = (other, cost) if other_cost < cost else (ahead, other_cost)
    costs = f"{min(cost, other_cost):.6g}, the other {worse:.6g}"
    return replace(best, why=f"costs after {TRIAL} iterations: {costs}")


def _from(name: str, ground: Ground) -> Start:
    values = _complete(INITIALIZATIONS[name](ground), ground)
    return Start(values, name, found=ground.found)


def _advanced(start: Start, ground: Ground, options: Options, progress: Progress) -> tuple[Start, float]:
    """The start a few iterations on, and its cost there."""
    held = gauges(ground.factors, ground.found, start.values, ground.space)
    trial = replace(options, method="lm", iterations=TRIAL)
    descent = Descent([*ground.factors, *held], ground.found.touched(start.values), trial, progress)
    before, stop = descent.cost, descent.run()
    values = gtsam.Values(start.values)
    values.update(descent.values)
    settled = stop if stop in (NO_FALL, SETTLED) else ""
    ahead = replace(start, values=values, cost=before, steps=tuple(descent.steps), settled=settled)
    return ahead, descent.cost


def _wound(ground: Ground, values: gtsam.Values) -> tuple[float, float]:
    """The angles (rad) by which odometry, and by which any edge, disagrees with the values at worst."""
    angles = turns(ground.edges, rotations_of(ground.space, values, ground.found))
    along = angles[np.array(ground.edges.motion, dtype=bool)]
    return float(along.max(initial=0.0)), float(angles.max(initial=0.0))


def _stated(ground: Ground) -> gtsam.Values:
    if not ground.states_all:
        raise BadConfig(
            "initialization 'file': the graph states no vertices, or not all of them; use odometry"
        )
    return ground.stated


def _odometry(ground: Ground) -> gtsam.Values:
    """Along odometry edges as far as they lead, then over as few others as possible: a search in which odometry is free."""
    edges = ground.edges
    poses: dict[int, Pose] = dict.fromkeys(ground.roots, ground.space.identity)
    beside: list[list[tuple[int, int]]] = [[] for _ in ground.found.keys]  # (edge, other end)
    for edge, (i, j) in enumerate(zip(edges.i.tolist(), edges.j.tolist(), strict=True)):
        beside[i].append((edge, j))
        beside[j].append((edge, i))
    ahead = deque((root, root, -1) for root in poses)  # (row, the row before it, the edge between)
    done = [False] * len(beside)
    while ahead:
        row, before, edge = ahead.popleft()
        if done[row]:
            continue
        done[row] = True
        if edge >= 0:
            step = edges.poses[edge]
            poses[row] = poses[before].compose(step if edges.j[edge] == row else step.inverse())
        for edge, other in beside[row]:
            if not done[other]:
                (ahead.appendleft if edges.motion[edge] else ahead.append)((other, row, edge))
    return _anchored(poses, ground)


def _chordal(ground: Ground) -> gtsam.Values:
    rotations, translations = chordal(ground.edges, np.array(ground.roots), len(ground.keys))
    poses = {
        row: pose_of_matrix(ground.space, rotation, translation)
        for row, (rotation, translation) in enumerate(zip(rotations, translations, strict=True))
    }
    return _anchored(poses, ground)


INITIALIZATIONS: Mapping[str, Callable[[Ground], gtsam.Values]] = {
    "file": _stated,
    "odometry": _odometry,
    "chordal": _chordal,
}


def _anchored(poses: Mapping[int, Pose], ground: Ground) -> gtsam.Values:
    """Each island moved to what holds it in space, else to where the file states its first pose."""
    shift: dict[int, Pose] = {}
    fixing = [factor for factor in ground.factors if factor.kind in FIXING and is_pose(factor.keys[0])]
    for row, factor in zip(ground.found.rows([f.keys[0] for f in fixing]).tolist(), fixing, strict=True):
        if (island := int(ground.island[row])) not in shift:
            shift[island] = factor.factor.prior().compose(poses[row].inverse())
    for root in ground.roots:
        if root not in shift and ground.stated.exists(ground.keys[root]):
            stated = ground.space.pose_in(ground.stated, ground.keys[root])
            shift[root] = stated.compose(poses[root].inverse())
    values = gtsam.Values()
    for row, (key, island) in enumerate(zip(ground.keys, ground.island.tolist(), strict=True)):
        if is_pose(key):
            values.insert(key, shift[island].compose(poses[row]) if island in shift else poses[row])
    return values


def _complete(poses: gtsam.Values, ground: Ground) -> gtsam.Values:
    """With what the file states of vertices that nothing touches, and landmarks where the file or else a sighting says."""
    values = gtsam.Values(ground.stated)
    values.insert_or_assign(poses)
    add_landmarks(values, ground.factors, ground.space)
    for key in ground.keys:
        if not values.exists(key):
            raise SolverFailure(f"nothing says where {gtsam.DefaultKeyFormatter(key)} might be", ())
    return values


def add_landmarks(values: gtsam.Values, factors: Sequence[Factor], space: Space) -> None:
    """Those without a value: where their first sighting says, else where most of their ranges meet."""
    ranges: dict[int, list[Factor]] = defaultdict(list)
    for factor in factors:
        if factor.kind != "landmark" or values.exists(key := factor.keys[1]):
            continue
        measured = factor.factor.measured()
        if isinstance(measured, float):
            ranges[key].append(factor)
        else:
            pose = space.pose_in(values, factor.keys[0])
            values.insert(key, pose.compose(measured) if is_posed(key) else pose.transformFrom(_seen(factor)))
    for key, ranging in ranges.items():
        if not values.exists(key):
            values.insert(key, place([_distance(each, values, space) for each in ranging]).others[0])


def _distance(factor: Factor, values: gtsam.Values, space: Space) -> Sighting:
    noise = without_kernel(factor.factor.noiseModel())
    pose, sigma = space.pose_in(values, factor.keys[0]), float(noise.sigmas()[0])
    return Sighting(pose, factor.keys[0], factor.factor.measured(), sigma, None, 0.0)


def _seen(factor: Factor) -> Array:
    """A landmark in the frame of the pose that saw it, from its bearing and range."""
    measured = factor.factor.measured()
    bearing = measured.bearing()
    direction = bearing.point3() if hasattr(bearing, "point3") else np.array([bearing.c(), bearing.s()])
    return np.asarray(direction * measured.range())
