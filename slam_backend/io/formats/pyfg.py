"""PyFG text files (https://github.com/MarineRoboticsGroup/PyFactorGraph): stamps in seconds, names, covariances.

Names are a letter and a number (A12, L3) and become 64-bit keys with the letter in the top byte. Covariances stand row by
row, translation first; they are kept beside the information that is computed from them, so that writing loses no bit.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...core.errors import BadFile
from ...core.measurement import Array
from .assemble import assemble
from .blocks import Line, Role, Table, read_blocks, tags_of, write_block
from .lines import Ids, Stamps, by_tag, read_rows, write_lines
from .noise import SCALAR, SE2, SE3, XY, XYZ, Pairs, fold, inverse
from .posegraph import Edges, Links, PoseGraph, name_of


def _table(
    pose: str, point: str, position: str, edge: str, states: int, noise: Pairs, axes: Pairs
) -> dict[Role, Line]:
    size = 2 if axes is XY else 3
    return {
        "vertex": Line(pose, 1, states, stamped=True, named=True),
        "landmark": Line(point, 1, size, named=True),
        "prior": Line(f"{pose}:PRIOR", 1, states, noise, stamped=True, named=True),
        "landmark_prior": Line(f"{point}:PRIOR", 1, size, axes, stamped=True, named=True),
        "edge": Line(edge, 2, states, noise, stamped=True, named=True),
        "sighting": Line(position, 2, size, axes, stamped=True, named=True),
        "range": Line("EDGE_RANGE", 2, 1, SCALAR, stamped=True, named=True),
    }


TABLE: Table = {
    "2d": _table("VERTEX_SE2", "VERTEX_XY", "EDGE_SE2_XY", "EDGE_SE2", 3, SE2, XY),
    "3d": _table("VERTEX_SE3:QUAT", "VERTEX_XYZ", "EDGE_SE3_XYZ", "EDGE_SE3:QUAT", 7, SE3, XYZ),
}
TAGS = tags_of(TABLE)


def read(path: Path) -> PoseGraph:
    """A PyFG file; BadFile names file, line and words of what is wrong."""
    groups, notes = by_tag(read_rows(path), TAGS)
    space, blocks = read_blocks(groups, TABLE)
    return assemble(space, blocks, notes, covariances=True)


def write(path: Path, graph: PoseGraph) -> tuple[str, ...]:
    """The graph as PyFG. Vertices without stamps get those of `PoseGraph.stamps_at`; ids that are no 64-bit robot keys
    become A<id> and L<id>. What PyFG cannot say is returned in words.
    """
    write_lines(path, _lines(path, graph))
    return (f"{len(graph.fixed)} fixed vertices",) if len(graph.fixed) else ()


def _lines(path: Path, graph: PoseGraph) -> Iterator[str]:
    table = TABLE[graph.space]
    vertices, landmarks = _names(path, graph.ids, "A"), _names(path, graph.landmarks, "L")
    stamps = graph.stamps_at() if graph.stamps is None else graph.stamps
    if graph.states is not None:
        yield from write_block(path, table["vertex"], [vertices], graph.states, stamps=stamps)
    if not np.isnan(graph.positions).all():
        yield from write_block(path, table["landmark"], [landmarks], graph.positions)
    parts: tuple[tuple[Role, Links, list[list[str]]], ...] = (
        ("prior", graph.priors, [vertices]),
        ("landmark_prior", graph.landmark_priors, [landmarks]),
        ("edge", graph.edges, [vertices, vertices]),
        ("sighting", graph.sightings, [vertices, landmarks]),
    )
    for role, links, names in parts:
        if len(links):
            ends = [
                [name[k] for k in rank.tolist()]
                for name, rank in zip(names, (links.i, links.j), strict=False)
            ]
            times = _times(links, stamps, role == "landmark_prior")
            covariances = fold(_covariances(path, links, table[role], ends), table[role].noise)
            yield from write_block(path, table[role], ends, links.states, covariances, times)
    if len(ranges := graph.ranges):
        far = (landmarks if landmark else vertices for landmark in ranges.to_landmark.tolist())
        ends = [
            [vertices[k] for k in ranges.i.tolist()],
            [names[k] for names, k in zip(far, ranges.j.tolist(), strict=True)],
        ]
        times = stamps[ranges.i] if ranges.stamps is None else ranges.stamps
        yield from write_block(
            path, table["range"], ends, ranges.ranges[:, None], ranges.variances[:, None], times
        )


def _times(links: Links, stamps: Stamps, timeless: bool) -> Stamps:
    """When a measurement was made: as the file said, else with its later vertex."""
    if links.stamps is not None:
        return links.stamps
    if timeless:
        return np.zeros(len(links), dtype=np.int64)
    ends = (links.i, links.j) if isinstance(links, Edges) else (links.i,)
    return np.asarray(np.max([stamps[end] for end in ends], axis=0))


def _covariances(path: Path, links: Links, line: Line, ends: list[list[str]]) -> Array:
    if links.covariance is not None:
        return links.covariance
    covariances = inverse(links.information)
    singular = ~np.isfinite(covariances).all(axis=(1, 2))
    if singular.any():
        words = " ".join([line.tag, *(end[int(singular.argmax())] for end in ends)])
        raise BadFile(f"{path}: {words}: its information matrix is singular: PyFG states covariances")
    return covariances


def _names(path: Path, ids: Ids, letter: str) -> list[str]:
    """PyFG names of ids: robot keys as they are, others after `letter`."""
    names = []
    for identifier in ids.tolist():
        name = name_of(identifier)
        if name.isdigit():
            if identifier >= 2**56:
                raise BadFile(f"{path}: id {identifier} has no PyFG name (a letter and a number below 2^56)")
            name = f"{letter}{name}"
        names.append(name)
    if len(set(names)) < len(names):
        raise BadFile(
            f"{path}: two ids have the same PyFG name (a robot key {letter}<n> beside the number n)"
        )
    return names
