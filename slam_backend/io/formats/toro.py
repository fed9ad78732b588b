"""TORO text files (http://openslam.org/toro.html): VERTEX2 and EDGE2, VERTEX3 and EDGE3 (roll pitch yaw).

TORO's planar information stands in the order xx xy yy tt xt yt, and along the axes of the edge's *first* vertex: it is
turned to the second's, where everybody else has it. (Proof: CSAIL's TORO file and its g2o file then agree to 1e-9.)
Files of other programs under the same tags have it row by row (xx xy xt yy yt tt) and as g2o means it; they are told apart by
the third number, which TORO's own never have at zero or below and such files have wherever x and theta are not correlated.
The 3-D information stands row by row, translation first, and is taken as that of the second vertex.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.geometry import rotation_of
from ...core.measurement import Array, frozen
from .assemble import assemble
from .blocks import Block, Blocks, Line, Table, read_blocks, tags_of, write_block, written_ids
from .lines import by_tag, read_rows, write_lines
from .noise import SE2, SE2_TORO, SE3, fold, turned
from .posegraph import PoseGraph

TABLE: Table = {
    "2d": {"vertex": Line("VERTEX2", 1, 3), "edge": Line("EDGE2", 2, 3, SE2_TORO)},
    "3d": {"vertex": Line("VERTEX3", 1, 6), "edge": Line("EDGE3", 2, 6, SE3)},
}
BARE = Line("EDGE3", 2, 6)  # some files state no noise in 3-D
TAGS = tags_of(TABLE)


def read(path: Path) -> PoseGraph:
    """A TORO file; BadFile names file, line and words of what is wrong."""
    groups, notes = by_tag(read_rows(path), TAGS)
    bare = bool(groups["EDGE3"]) and len(groups["EDGE3"].words[0]) == BARE.first + BARE.ids + BARE.states
    table = {**TABLE, "3d": {**TABLE["3d"], "edge": BARE}} if bare else TABLE
    space, blocks = read_blocks(groups, table)
    if space == "3d":
        blocks = {role: _with_quaternions(block) for role, block in blocks.items()}
    if bare:
        blocks["edge"] = _with_unit_noise(blocks["edge"])
        notes = (*notes, "the edges state no information: taken as the identity")
    if space == "2d" and _row_by_row(blocks):
        blocks["edge"] = blocks["edge"]._replace(line=Line("EDGE2", 2, 3, SE2))
        return assemble(space, blocks, (*notes, "information in the order xx xy xt yy yt tt, not TORO's own"))
    graph = assemble(space, blocks, notes)
    if space == "3d" or not len(graph.edges):
        return graph
    information = frozen(_turned_by(graph.edges.information, graph.edges.states[:, 2]))
    return replace(graph, edges=replace(graph.edges, information=information))


def write(path: Path, graph: PoseGraph) -> tuple[str, ...]:
    """The graph as TORO; what it cannot say is returned in words.

    To the bit in 2-D, except information that has to be turned (1e-15); in 3-D through roll, pitch and yaw.
    """
    write_lines(path, _lines(path, graph))
    parts = (
        ("landmarks", graph.landmarks), ("sightings", graph.sightings), ("ranges", graph.ranges),
        ("priors", graph.priors), ("priors of landmarks", graph.landmark_priors), ("fixed vertices", graph.fixed),
    )  # fmt: skip
    left = [f"{len(part)} {name}" for name, part in parts if len(part)]
    return (*left, "stamps") if graph.stamps is not None else tuple(left)


def _lines(path: Path, graph: PoseGraph) -> Iterator[str]:
    table, edges = TABLE[graph.space], graph.edges
    if graph.states is not None:
        yield from write_block(path, table["vertex"], [written_ids(graph.ids)], _stated(graph, graph.states))
    if len(edges):
        ends = [written_ids(graph.ids, edges.i), written_ids(graph.ids, edges.j)]
        planar = graph.space == "2d"
        information = _turned_by(edges.information, -edges.states[:, 2]) if planar else edges.information
        noise = fold(information, table["edge"].noise)
        yield from write_block(path, table["edge"], ends, _stated(graph, edges.states), noise)


def _row_by_row(blocks: Blocks) -> bool:
    """Whether planar information is not in TORO's order: there the third number is that of y, always positive."""
    if "edge" not in blocks:
        return False
    noise = blocks["edge"].noise
    return bool((noise[:, 2] <= 0).any() and (noise[:, 5] > 0).all())


def _turned_by(information: Array, theta: Array) -> Array:
    """(M, 3, 3) information of x y theta, along axes that are turned by theta; what looks the same from all sides stays."""
    xy, xt, yt = information[:, 0, 1], information[:, 0, 2], information[:, 1, 2]
    alike = (information[:, 0, 0] == information[:, 1, 1]) & (xy == 0) & (xt == 0) & (yt == 0)
    R = np.tile(np.eye(3), (len(theta), 1, 1))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(theta)
    R[:, 1, 0] = np.sin(theta)
    R[:, 0, 1] = -R[:, 1, 0]
    return np.asarray(np.where(alike[:, None, None], information, turned(information, R)))


def _with_quaternions(block: Block) -> Block:
    """X y z roll pitch yaw to x y z qx qy qz qw."""
    half = block.states[:, 3:] / 2
    (sr, sp, sy), (cr, cp, cy) = np.sin(half).T, np.cos(half).T
    quaternions = (
        sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    )  # fmt: skip
    return block._replace(states=np.column_stack([block.states[:, :3], *quaternions]))


def _with_unit_noise(block: Block) -> Block:
    unit = np.tile(fold(np.eye(6)[None], SE3), (len(block.rows), 1))
    return block._replace(line=block.line._replace(noise=SE3), noise=unit)


def _stated(graph: PoseGraph, states: Array) -> Array:
    """States as TORO has them: roll pitch yaw in 3-D."""
    if graph.space == "2d":
        return states
    R = rotation_of(states[:, 3:])
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 0, 0], R[:, 1, 0]))
    return np.column_stack([states[:, :3], roll, pitch, yaw])
