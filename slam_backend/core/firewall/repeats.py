"""A relative pose that is told twice is one observation: counted twice, it would weigh twice."""

from collections.abc import Hashable

from ..sensors.relative import RelativePose
from .rules import MOST_WAITING


class Repeats:
    """Knows the last MOST_WAITING relative poses. The edges of a graph file are what they are: costs are known with them."""

    def __init__(self) -> None:
        self._known: dict[Hashable, None] = {}  # oldest first

    def told(self, item: RelativePose) -> bool:
        """Whether this very pose between the same two moments, by the same source, has come before."""
        if item.information is not None:
            return False
        said = (item.source, item.ends, item.frame_i, item.frame_j, item.pose.tobytes())
        if said in self._known:
            return True
        self._known[said] = None
        if len(self._known) > MOST_WAITING:
            del self._known[next(iter(self._known))]
        return False
