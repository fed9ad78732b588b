"""Where landmarks should be seen from a keyframe, and how sure that is: by the solver's own joint covariance, carried on by the odometry."""

from collections.abc import Sequence

import numpy as np

from ..context import Context
from ..errors import SolverFailure
from ..graph import Keyframe
from ..measurement import Array
from ..space import Space
from ..variables import is_posed


def predicted(
    keyframe: Keyframe, keys: Sequence[int], points: Array, a: Keyframe | None, context: Context
) -> tuple[Array, Array]:
    """(K, d) points in the frame of a keyframe, and (K d, K d) the joint covariance of that.

    points: (K, d) where the landmarks are believed to be in the map. a: the keyframe before this one.
    """
    space, pose = context.space, context.pose(keyframe.pose)
    d, size = space.point_dimension, space.dimension
    ends = np.cumsum([size, *(_width(key, space) for key in keys)])
    seen, jacobian = np.zeros((len(keys), d)), np.zeros((len(keys) * d, ends[-1]))
    of_pose, of_point = np.zeros((d, size), order="F"), np.zeros((d, d), order="F")
    for k, key in enumerate(keys):
        seen[k] = pose.transformTo(points[k], of_pose, of_point)
        rows, begin = slice(k * d, k * d + d), int(ends[k])
        jacobian[rows, :size] = of_pose
        if is_posed(key):  # the tangent of a tag turns with it
            at = slice(begin + space.translation.start, begin + space.translation.stop)
            jacobian[rows, at] = of_point @ context.pose(key).rotation().matrix()
        else:
            jacobian[rows, begin : begin + d] = of_point
    if not keys:
        return seen, np.zeros((0, 0))
    joint = _joint(keyframe, keys, int(ends[-1]), a, context)
    return seen, jacobian @ joint @ jacobian.T


def _width(key: int, space: Space) -> int:
    return space.dimension if is_posed(key) else space.point_dimension


def _joint(
    keyframe: Keyframe, keys: Sequence[int], total: int, a: Keyframe | None, context: Context
) -> Array:
    """Of the keyframe's pose and landmarks. A keyframe that the solver does not know yet is as sure as the one before it and
    the odometry since.
    """
    estimate, size = context.estimate, context.space.dimension
    if estimate is None:
        return np.zeros((total, total))
    known = estimate.knows(keyframe.pose)
    origin = keyframe if known or a is None else a
    try:
        joint = np.array(estimate.covariance([origin.pose, *keys]))
    except SolverFailure:
        joint = np.zeros((total, total))  # then the sighting's own noise is all there is
    if not known and a is not None:
        motion = context.motion(a.stamp, keyframe.stamp)
        carry = np.eye(total)
        carry[:size, :size] = motion.pose.inverse().AdjointMap()
        joint = carry @ joint @ carry.T
        joint[:size, :size] += motion.covariance
    return joint
