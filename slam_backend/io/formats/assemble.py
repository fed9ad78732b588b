"""From the blocks of a graph file to a PoseGraph: names become ranks, noise becomes matrices, contradictions errors."""

from typing import Any

import numpy as np

from ...core.measurement import Array, frozen
from .blocks import Block, Blocks, Role
from .lines import Ids, Ranks, Rows
from .noise import inverse, least_correlation, unfold
from .posegraph import Edges, Links, PoseGraph, Priors, Ranges, Sightings, SpaceName

INDEFINITE = -1e-9  # smallest scaled eigenvalue that the rounding of a file's decimals explains
LETTER_L = ord("L")  # what PyFG calls a landmark
Mention = tuple[Role, int]  # (role of a line, which of its ids)
LANDMARK_MENTIONS: tuple[Mention, ...] = (("sighting", 1), ("landmark_prior", 0), ("range", 1))
VERTEX_MENTIONS: tuple[Mention, ...] = (
    ("edge", 0), ("edge", 1), ("sighting", 0), ("prior", 0), ("fixed", 0), ("range", 0), ("range", 1),
)  # fmt: skip


def assemble(
    space: SpaceName,
    blocks: Blocks,
    notes: tuple[str, ...] = (),
    covariances: bool = False,
    weights: Array | None = None,
) -> PoseGraph:
    """covariances: the noise of the lines is covariance, else information. weights: scale of the axes of 6x6 information.

    BadFile if an end has no line of its own in a file that has such lines, a vertex is stated twice differently, an
    edge ends where it begins, or a noise matrix is indefinite.
    """
    landmarks = settled_ids(blocks, "landmark", *LANDMARK_MENTIONS)
    ids = settled_ids(blocks, "vertex", *VERTEX_MENTIONS)
    kinds: tuple[tuple[Role, str, type[Links], Ids, Ids], ...] = (
        ("edge", "edges", Edges, ids, ids),
        ("sighting", "sightings", Sightings, ids, landmarks),
        ("prior", "priors", Priors, ids, ids),
        ("landmark_prior", "landmark_priors", Priors, landmarks, landmarks),
    )
    parts: dict[str, Any] = {
        name: _links(kind, blocks[role], i, j, covariances, weights)
        for role, name, kind, i, j in kinds
        if role in blocks
    }
    if "range" in blocks:
        parts["ranges"] = _ranges(blocks["range"], ids, landmarks)
    if "fixed" in blocks:
        parts["fixed"] = ranks(ids, blocks["fixed"], 0)
    if vertex := blocks.get("vertex"):
        rows = _first_of_each(vertex)
        parts["states"] = frozen(vertex.states[rows])
        parts["stamps"] = None if vertex.stamps is None else vertex.stamps[rows]
    positions = _positions(space, blocks, landmarks)
    return PoseGraph(space, ids, landmarks=landmarks, positions=positions, notes=notes, **parts)


def settled_ids(blocks: Blocks, stated: Role, *mentions: Mention) -> Ids:
    """The ids that have lines of their own; in a file that has no such lines, all that are mentioned."""
    block = blocks.get(stated)
    if block is None:
        found = [_mentioned(blocks[role], end, stated) for role, end in mentions if role in blocks]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.uint64), *found]))
    order = np.argsort(block.ids[0], kind="stable")
    twice = np.flatnonzero(block.ids[0][order][1:] == block.ids[0][order][:-1])
    for first, second in zip(order[twice].tolist(), order[twice + 1].tolist(), strict=True):
        if not np.array_equal(block.states[first], block.states[second]):
            line = block.rows.numbers[first]
            raise block.bad(second, f"is stated a second time with other numbers (before: line {line})")
    return np.unique(block.ids[0])


def ranks(known: Ids, block: Block, end: int) -> Ranks:
    """Ranks of the ids at one end of each line; BadFile if one of them has no line of its own."""
    found = np.searchsorted(known, block.ids[end])
    missing = np.append(known, np.uint64(0))[found] != block.ids[end]
    missing |= found == len(known)
    if missing.any():
        row = int(missing.argmax())
        word = block.rows.words[row][block.line.first + end]
        raise block.bad(row, f"{word} has no VERTEX line in this file")
    return found.astype(np.int64)


def _mentioned(block: Block, end: int, role: Role) -> Ids:
    ids = block.ids[end]
    if (block.line.named, block.line.states, end) != (True, 1, 1):
        return ids
    is_landmark = (ids >> np.uint64(56)) == LETTER_L  # the far end of a range is either
    return np.asarray(ids[is_landmark == (role == "landmark")])


def _links(
    kind: type[Links], block: Block, i: Ids, j: Ids, covariances: bool, weights: Array | None
) -> Links:
    information, covariance = _noise(block, covariances, weights)
    far = 1 if len(block.ids) > 1 else 0
    links = kind(
        ranks(i, block, 0), ranks(j, block, far), frozen(block.states), information, covariance, block.stamps
    )
    if kind is Edges and len(itself := np.flatnonzero(links.i == links.j)):
        raise block.bad(int(itself[0]), "is an edge from a vertex to itself")
    return links


def _noise(block: Block, covariances: bool, weights: Array | None) -> tuple[Array, Array | None]:
    """Information, and the covariance that it comes from where the file states one."""
    stated = unfold(block.noise, block.line.noise)
    what = "covariance" if covariances else "information"
    indefinite = least_correlation(stated) < INDEFINITE
    if indefinite.any():
        raise block.bad(int(indefinite.argmax()), f"its {what} matrix is indefinite")
    if not covariances:
        scaled = weights is not None and stated.shape[1] == len(weights)
        return frozen(stated * np.outer(weights, weights) if scaled and weights is not None else stated), None
    information = inverse(stated)
    singular = ~np.isfinite(information).all(axis=(1, 2))
    if singular.any():
        raise block.bad(int(singular.argmax()), f"its {what} matrix is singular")
    return frozen(information), frozen(stated)


def _ranges(block: Block, ids: Ids, landmarks: Ids) -> Ranges:
    to_landmark = np.isin(block.ids[1], landmarks)
    j = np.zeros(len(block.rows), dtype=np.int64)
    j[to_landmark] = np.searchsorted(landmarks, block.ids[1][to_landmark])
    j[~to_landmark] = ranks(ids, _part(block, np.flatnonzero(~to_landmark).tolist()), 1)
    values, variances = block.states[:, 0], block.noise[:, 0]
    for wrong, what in (
        (values < 0, "its range is negative"),
        (variances <= 0, "its variance is not positive"),
    ):
        if wrong.any():
            raise block.bad(int(wrong.argmax()), what)
    return Ranges(ranks(ids, block, 0), j, to_landmark, frozen(values), frozen(variances), block.stamps)


def _part(block: Block, rows: list[int]) -> Block:
    part = Rows(block.rows.path, [block.rows.numbers[k] for k in rows], [block.rows.words[k] for k in rows])
    return block._replace(rows=part, ids=tuple(ids[rows] for ids in block.ids))


def _first_of_each(block: Block) -> Ranks:
    """The row of each id, in the order of the sorted ids."""
    return np.unique(block.ids[0], return_index=True)[1].astype(np.int64)


def _positions(space: SpaceName, blocks: Blocks, landmarks: Ids) -> Array:
    if "landmark" in blocks:
        return frozen(blocks["landmark"].states[_first_of_each(blocks["landmark"])])
    return frozen(np.full((len(landmarks), 2 if space == "2d" else 3), np.nan))
