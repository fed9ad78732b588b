"""Where the sensors sit: `base_T_frame`, from the configuration or from /tf_static."""

from collections.abc import Mapping, Sequence

from .graph import Pose
from .measurement import StaticTransform
from .space import Space, Spatial

SPATIAL = Spatial()


class Mounts:
    """Frames by name. The configuration wins over /tf_static, for what hangs below its frames too; '', 'base' and
    the base frame are the base itself. Chains are composed in 3-D whatever the space: the frames between a planar
    base and its sensor may be tilted.
    """

    def __init__(self, space: Space, base: str, extrinsics: Mapping[str, Sequence[float]]) -> None:
        self._space, self._base = space, base.lstrip("/")
        self._given = {frame.lstrip("/"): SPATIAL.from_extrinsics(six) for frame, six in extrinsics.items()}
        self._parents: dict[str, tuple[str, Pose]] = {}
        self._found: dict[str, Pose] = {}

    def name_base(self, frame: str) -> None:
        """The frame that the driving source tells the pose of, unless the configuration names another."""
        if not self._base and frame:
            self._base = frame.lstrip("/")
            self._found.clear()

    def add(self, transform: StaticTransform) -> None:
        parent, child = transform.parent.lstrip("/"), transform.child.lstrip("/")
        if child != parent:
            self._parents[child] = (parent, SPATIAL.pose(transform.pose.tolist()))
            self._found.clear()

    def get(self, frame: str) -> Pose | None:
        """`base_T_frame`; the space's own `identity` object for the base; None when unknown."""
        found = self._found.get(frame)
        if found is None and (whole := self.whole(frame)) is not None:
            here = whole is SPATIAL.identity
            found = self._space.identity if here else self._space.pose(SPATIAL.seven(whole))
            self._found[frame] = found
        return found

    def whole(self, frame: str) -> Pose | None:
        """The same in 3-D, whatever the space."""
        if frame in ("", "base", self._base):
            return SPATIAL.identity
        return self._given.get(frame) or self._search(frame)

    def _search(self, frame: str) -> Pose | None:
        """Through the nearest common ancestor of the frame and the base."""
        above_base = self._ancestors(self._base)
        above_frame = self._ancestors(frame)
        for ancestor, ancestor_T_frame in above_frame.items():
            if ancestor in self._given:
                return self._given[ancestor].compose(ancestor_T_frame)
            if ancestor in above_base:
                return above_base[ancestor].inverse().compose(ancestor_T_frame)
        return None

    def _ancestors(self, frame: str) -> dict[str, Pose]:
        """Ancestor -> `ancestor_T_frame`, nearest first, the frame itself included."""
        found = {frame: SPATIAL.identity}
        pose = SPATIAL.identity
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in found:
                break  # a loop in the tree: a wrong /tf_static; what lies before it still holds
            pose = step.compose(pose)
            found[frame] = pose
        return found
