"""The final graph as the graph formats have it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.graph import Factor
from ..core.measurement import Array
from ..core.space import Space
from .formats.posegraph import Edges, PoseGraph, Priors, Sightings
from .result import Result


def pose_graph(result: Result) -> PoseGraph:
    """The kept factors at the final estimate. Left out: gauges, kernels, bearings without range, which no
    format has, and tags with an orientation: there are no landmarks of that kind in any.
    """
    backend, space = result.run.backend, result.run.backend.space
    keyframes = sorted(backend.timeline.keyframes, key=lambda k: k.index)
    ids = [_id(result, k.stamp, k.index) for k in keyframes]
    rank = {keyframes[n].pose: r for r, n in enumerate(np.argsort(ids))}
    points = [n for n, name in enumerate(result.snapshot.names) if name not in result.snapshot.orientations]
    landmark_rank = {backend.landmark(result.snapshot.names[n]): rank for rank, n in enumerate(points)}
    order = np.argsort(ids)
    states = np.array([_state(space, space.pose_in(result.values, keyframes[n].pose)) for n in order])
    by_kind: dict[str, list[Factor]] = {"edges": [], "sightings": [], "priors": []}
    for factor in result.factors:
        if factor.kind in ("motion", "odometry", "loop"):
            by_kind["edges"].append(factor)
        elif factor.kind == "pose":
            by_kind["priors"].append(factor)
        elif (
            factor.kind == "landmark"
            and factor.keys[-1] in landmark_rank
            and hasattr(factor.factor.measured(), "range")
        ):
            by_kind["sightings"].append(factor)
    dimension = space.point_dimension
    return PoseGraph(
        "2d" if space.name == "2d" else "3d",
        np.array(sorted(ids), dtype=np.uint64),
        states,
        Edges(*_links(by_kind["edges"], rank, rank, lambda f: _edge(space, f), space)),
        stamps=np.array([keyframes[n].stamp for n in order], dtype=np.int64),
        landmarks=np.arange(len(landmark_rank), dtype=np.uint64),
        positions=result.snapshot.landmarks[points, :dimension],
        sightings=Sightings(
            *_links(
                by_kind["sightings"],
                rank,
                landmark_rank,
                lambda f: _sighting(space, f.factor),
                space,
                dimension,
            )
        ),
        priors=Priors(
            *_links(
                by_kind["priors"],
                rank,
                rank,
                lambda f: (_state(space, f.factor.prior()), _information(f.factor)),
                space,
            )
        ),
    )


def _id(result: Result, stamp: int, index: int) -> int:
    """The vertex id of a graph file that was replayed, else the keyframe's index."""
    vertex = result.run.inputs.vertex(stamp)
    return index if vertex is None else vertex


def _links(
    factors: Sequence[Factor], first: Any, second: Any, measured: Any, space: Space, size: int | None = None
) -> tuple[Any, ...]:
    """(i, j, states, information) as Links takes them."""
    width = size or len(_state(space, space.identity))
    depth = size or space.dimension
    rows = [measured(factor) for factor in factors]
    ends = [[key for key in factor.keys if key in first or key in second] for factor in factors]
    return (
        np.array([first[each[0]] for each in ends], dtype=np.int64),
        np.array([second[each[-1]] for each in ends], dtype=np.int64),
        np.array([row[0] for row in rows]).reshape(-1, width),
        np.array([row[1] for row in rows]).reshape(-1, depth, depth),
    )


def _state(space: Space, pose: Any) -> tuple[float, ...]:
    return space.numbers(pose) if space.name == "2d" else space.seven(pose)


def _edge(space: Space, factor: Factor) -> tuple[tuple[float, ...], Array]:
    """What was measured, and its information. No format has velocities and biases: of an IMU the motion as it was predicted."""
    if factor.motion is not None:
        return _state(space, factor.motion.pose), np.asarray(np.linalg.inv(factor.motion.covariance))
    return _state(space, factor.factor.measured()), _information(factor.factor)


def _information(factor: Any) -> Array:
    noise = factor.noiseModel()
    return np.asarray((noise.noise() if hasattr(noise, "noise") else noise).information())


def _sighting(space: Space, factor: Any) -> tuple[Array, Array]:
    """Position and its information from bearing and range, to first order, as they were made."""
    measured = factor.measured()
    bearing, distance = measured.bearing(), measured.range()
    if space.name == "2d":
        direction = np.array([bearing.c(), bearing.s()])
        turn = np.array([[-bearing.s()], [bearing.c()]])
    else:
        direction, turn = bearing.point3(), bearing.basis()
    to_polar = np.vstack([turn.T / distance, direction])
    return direction * distance, to_polar.T @ _information(factor) @ to_polar
