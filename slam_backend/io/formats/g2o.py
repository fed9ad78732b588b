"""g2o text files (https://github.com/RainerKuemmerle/g2o/wiki/File-Format).

2-D: VERTEX_SE2, VERTEX_XY, EDGE_SE2, EDGE_SE2_XY. 3-D: VERTEX_SE3:QUAT, VERTEX_TRACKXYZ, EDGE_SE3:QUAT,
EDGE_SE3_TRACKXYZ with PARAMS_SE3OFFSET. Both: FIX. Other tags are skipped and counted in the notes.

A 3-D file has translation first. Its information of rotation is that of the quaternion's vector part, half the angle,
where g2o wrote it; GTSAM's reader and many programs take it for that of the angle itself. `rotation_information`
chooses: "gtsam" as it stands, "g2o" a quarter of it (half, where rotation meets translation).
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core.geometry import rotation_of
from ...core.measurement import Array, frozen
from .assemble import assemble
from .blocks import Block, Line, Table, read_block, read_blocks, tags_of, write_block, written_ids
from .lines import Rows, by_tag, read_rows, write_lines
from .noise import HALF_ANGLE, SE2, SE3, XY, XYZ, fold, turned
from .posegraph import Convention, PoseGraph, Sightings

TABLE: Table = {
    "2d": {
        "vertex": Line("VERTEX_SE2", 1, 3),
        "landmark": Line("VERTEX_XY", 1, 2),
        "edge": Line("EDGE_SE2", 2, 3, SE2),
        "sighting": Line("EDGE_SE2_XY", 2, 2, XY),
    },
    "3d": {
        "vertex": Line("VERTEX_SE3:QUAT", 1, 7),
        "landmark": Line("VERTEX_TRACKXYZ", 1, 3),
        "edge": Line("EDGE_SE3:QUAT", 2, 7, SE3),
        "sighting": Line("EDGE_SE3_TRACKXYZ", 3, 3, XYZ),  # the third id names the sensor's offset
    },
}
FIX = Line("FIX", 1)
OFFSET = Line("PARAMS_SE3OFFSET", 1, 7)
TAGS = [*tags_of(TABLE), FIX.tag, OFFSET.tag]


def read(path: Path, rotation_information: Convention = "gtsam") -> PoseGraph:
    """A g2o file; BadFile names file, line and words of what is wrong."""
    groups, notes = by_tag(read_rows(path), TAGS)
    space, blocks = read_blocks(groups, TABLE)
    if groups[FIX.tag]:
        blocks["fixed"] = read_block(FIX, _one_id_each(groups[FIX.tag]))
    graph = assemble(space, blocks, notes, weights=HALF_ANGLE if rotation_information == "g2o" else None)
    if space == "3d" and "sighting" in blocks:
        offsets = _offsets(blocks["sighting"], read_block(OFFSET, groups[OFFSET.tag]))
        sightings = _in_vertex_frame(graph.sightings, offsets)
        if not (finite := np.isfinite(sightings.states).all(axis=1)).all():
            raise blocks["sighting"].bad(int(finite.argmin()), "is too far away for a number")
        return replace(graph, sightings=sightings)
    return graph


def write(path: Path, graph: PoseGraph, rotation_information: Convention = "gtsam") -> tuple[str, ...]:
    """The graph as g2o, every number to the bit; what g2o cannot say is returned in words."""
    write_lines(path, _lines(path, graph, rotation_information))
    parts = (
        ("ranges", graph.ranges),
        ("priors", graph.priors),
        ("priors of landmarks", graph.landmark_priors),
    )
    left = [f"{len(part)} {name}" for name, part in parts if len(part)]
    return (*left, "stamps") if graph.stamps is not None else tuple(left)


def _lines(path: Path, graph: PoseGraph, convention: Convention) -> Iterator[str]:
    table, edges, sightings = TABLE[graph.space], graph.edges, graph.sightings
    if graph.states is not None:
        yield from write_block(path, table["vertex"], (written_ids(graph.ids),), graph.states)
    if not np.isnan(graph.positions).all():
        yield from write_block(path, table["landmark"], (written_ids(graph.landmarks),), graph.positions)
    yield from (f"{FIX.tag} {word}" for word in written_ids(graph.ids, graph.fixed))
    ends = [written_ids(graph.ids, edges.i), written_ids(graph.ids, edges.j)]
    information = edges.information
    if convention == "g2o" and graph.space == "3d" and len(edges):
        information = information / np.outer(HALF_ANGLE, HALF_ANGLE)
    if len(edges):
        yield from write_block(
            path, table["edge"], ends, edges.states, fold(information, table["edge"].noise)
        )
    if len(sightings):
        ends = [written_ids(graph.ids, sightings.i), written_ids(graph.landmarks, sightings.j)]
        if graph.space == "3d":
            yield f"{OFFSET.tag} 0 0 0 0 0 0 0 1"
            ends.append(["0"] * len(sightings))
        noise = fold(sightings.information, table["sighting"].noise)
        yield from write_block(path, table["sighting"], ends, sightings.states, noise)


def _offsets(sightings: Block, offsets: Block) -> Array:
    """(M, 7) `vertex_T_sensor` of each sighting."""
    known = dict(zip(offsets.ids[0].tolist(), offsets.states, strict=True))
    for row, offset in enumerate(sightings.ids[2].tolist()):
        if offset not in known:
            raise sightings.bad(row, f"the sensor's offset {offset} has no {OFFSET.tag} line")
    return np.array([known[offset] for offset in sightings.ids[2].tolist()])


def _in_vertex_frame(sightings: Sightings, vertex_T_sensor: Array) -> Sightings:
    """From the sensor's frame to the vertex's; untouched to the bit if the two are the same."""
    if not vertex_T_sensor[:, :6].any():
        return sightings
    turn = rotation_of(vertex_T_sensor[:, 3:])
    with np.errstate(all="ignore"):
        states = (turn @ sightings.states[:, :, None])[:, :, 0] + vertex_T_sensor[:, :3]
    information = turned(sightings.information, np.swapaxes(turn, 1, 2))
    return replace(sightings, states=frozen(states), information=frozen(information))


def _one_id_each(rows: Rows) -> Rows:
    """FIX names any number of vertices in one line."""
    pairs = [
        (number, [words[0], word])
        for number, words in zip(rows.numbers, rows.words, strict=True)
        for word in words[1:]
    ]
    return Rows(rows.path, [number for number, _ in pairs], [words for _, words in pairs])
