"""Where a scan lies in a map when the predicted pose is off: two sightings and two landmarks as far apart say where, and
the others vote (the geometric-constraints search of Neira et al., ICRA 2003, with pairs as hypotheses).
"""

from typing import NamedTuple

import numpy as np

from ..measurement import Array
from .compatibility import Pairs, nearest

FEWEST, SHARE = 4, 0.6  # sightings that must agree, and of all
APART = 2.0  # m between the sightings of a pair: a short one says little of the direction
MOST_TURNED = 0.6  # rad that a prediction is off at most
MOST_HYPOTHESES = 4000


class Found(NamedTuple):
    pairs: Pairs
    moved: float  # m from the predicted to the found place
    turned: float  # rad


def consensus(seen: Array, landmarks: Array, tolerance: float, reach: float) -> Found | None:
    """seen: (n, d) from the predicted place, landmarks: (K, d) likewise, both along the axes of the map.

    The turn is about the vertical: roll and pitch of a robot do not drift. tolerance: m between a sighting and its landmark.
    """
    if len(seen) < FEWEST or len(landmarks) < FEWEST:
        return None
    turns, shifts = _hypotheses(seen, landmarks, tolerance, reach)
    if not len(turns):
        return None
    placed = _placed(seen, turns, shifts)
    gaps = np.linalg.norm(placed[:, :, None] - landmarks[None, None], axis=3)
    votes = (gaps.min(axis=2) <= tolerance).sum(axis=1)
    for row in np.argsort(-votes, kind="stable")[:5].tolist():
        found = _refined(seen, landmarks, (float(turns[row]), shifts[row]), tolerance)
        if len(found.pairs) >= max(FEWEST, SHARE * len(seen)) and found.moved <= reach:
            return found
    return None


def _hypotheses(seen: Array, landmarks: Array, tolerance: float, reach: float) -> tuple[Array, Array]:
    """(H,) turns and (H, d) shifts, the smallest shifts first."""
    first, second = np.triu_indices(len(seen), 1)
    across = seen[second, :2] - seen[first, :2]
    lengths = np.linalg.norm(across, axis=1)
    wide = np.flatnonzero(lengths > APART)
    spans = landmarks[None, :, :2] - landmarks[:, None, :2]
    distances = np.linalg.norm(spans, axis=2)
    which, u, v = np.nonzero(np.abs(distances[None] - lengths[wide, None, None]) <= tolerance)
    a, b = wide[which], spans[u, v]
    turns = np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(across[a, 1], across[a, 0])
    turns = (turns + np.pi) % (2 * np.pi) - np.pi
    middle = (seen[first[a]] + seen[second[a]]) / 2
    shifts = (landmarks[u] + landmarks[v]) / 2 - _turned(middle, turns)
    size = np.linalg.norm(shifts, axis=1)
    near = np.flatnonzero((np.abs(turns) <= MOST_TURNED) & (size <= reach))
    near = near[np.argsort(size[near], kind="stable")][:MOST_HYPOTHESES]
    return turns[near], shifts[near]


def _turned(points: Array, turns: Array) -> Array:
    """(H, d) each by its own turn."""
    c, s = np.cos(turns), np.sin(turns)
    turned = points.copy()
    turned[:, 0], turned[:, 1] = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    return turned


def _placed(seen: Array, turns: Array, shifts: Array) -> Array:
    """(H, n, d) the sightings under each hypothesis."""
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    placed = np.tile(seen, (len(turns), 1, 1))
    placed[:, :, 0], placed[:, :, 1] = c * seen[:, 0] - s * seen[:, 1], s * seen[:, 0] + c * seen[:, 1]
    return placed + shifts[:, None]


def _refined(seen: Array, landmarks: Array, start: tuple[float, Array], tolerance: float) -> Found:
    """The pairs of a hypothesis, its place fitted to them (Arun et al., PAMI 1987), and the pairs of that."""
    turn, shift = start
    pairs: Pairs = {}
    for _ in range(3):
        placed = _placed(seen, np.array([turn]), shift[None])[0]
        pairs = nearest(np.linalg.norm(placed[:, None] - landmarks[None], axis=2), tolerance)
        if len(pairs) < 2:
            break
        a, b = seen[list(pairs)], landmarks[list(pairs.values())]
        p, q = a - a.mean(axis=0), b - b.mean(axis=0)
        turn = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p[:, :2] * q[:, :2]).sum()))
        shift = b.mean(axis=0) - _turned(a.mean(axis=0)[None], np.array([turn]))[0]
    return Found(pairs, float(np.linalg.norm(shift)), abs(turn))
