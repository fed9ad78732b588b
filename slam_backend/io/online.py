"""A pose graph as if live: one vertex after the other through the back-end, the answer in the variables of the file."""

from collections.abc import Callable

import gtsam

from ..core.backend import Backend
from ..core.config import KernelName
from ..core.graph import Decision, keyframe, landmark_key
from ..core.solvers.initialize import add_landmarks
from .formats.posegraph import name_of
from .problem import Problem, config_of, odometry_edges, stream
from .replay import settled_stream


def solve_online(
    problem: Problem, kernel: KernelName, advance: Callable[[int], None]
) -> tuple[gtsam.Values, gtsam.Values]:
    """What iSAM2 believes at the end, and the same linearized anew. The first vertex of a part is its origin.

    advance: called with 1 for every vertex. What is `timeless` in the graph is not used.
    """
    config = config_of(problem.graph, kernel)
    backend = Backend(config)
    edges = stream(problem.graph, odometry_edges(problem.graph), apart=kernel != "none")
    for item in settled_stream(edges, config):
        if not isinstance(item, Decision):
            advance(len(backend.add(item)))
    backend.finish()
    online = _renamed(problem, backend)
    backend.polish()
    return online, _renamed(problem, backend)


def _renamed(problem: Problem, backend: Backend) -> gtsam.Values:
    """From keys in the order of creation to keys by rank."""
    found, values = backend.estimate.values(), gtsam.Values()
    for rank, stamp in enumerate(problem.graph.stamps_at().tolist()):
        if (known := backend.timeline.at(stamp)) is not None:
            values.insert(keyframe(rank, stamp).pose, problem.space.pose_in(found, known.pose))
    for rank, identifier in enumerate(problem.graph.landmarks.tolist()):
        if found.exists(key := backend.landmark(name_of(identifier))):
            values.insert(landmark_key(rank), problem.space.point_in(found, key))
    add_landmarks(values, problem.factors, problem.space)  # whose ranges did not place them by the end
    return values
