"""Tags: landmarks with an orientation of their own. One sighting tells the whole pose, and its factor is gtsam's between factor."""

from math import hypot

import numpy as np

from ..config import LandmarkSource
from ..context import Context, Unusable, defaulted
from ..graph import Motion, Pose
from ..measurement import Array
from ..mounts import SPATIAL

UPRIGHT = 0.5  # cosine of a tilt; below, x and y of a sensor are not those of the ground, and the x axis of a tag has no yaw


def tilted(context: Context, frame: str) -> Pose | None:
    """`base_T_frame` in 3-D, of a sensor that lies on its side in a plane: the optical frame of a camera; None otherwise."""
    whole = None if context.space.name == "3d" else context.mounts.whole(frame)
    return None if whole is None or whole.rotation().matrix()[2, 2] > UPRIGHT else whole


def tag_from_keyframe(
    seen: tuple[Array, Array], frame: str, mount: Pose, motion: Motion | None, context: Context, config: LandmarkSource
) -> Motion:  # fmt: skip
    """`keyframe_T_tag`, with the noise of the sighting and of the motion since the keyframe, at the tangent of the tag.

    seen: (7,) pose and (6, 6) covariance in ROS order, from the sensor. In a plane the tag's heading is that of its x axis,
    which is level on a wall, on the floor and on the ceiling alike.
    """
    (value, noise), space = seen, context.space
    noise = defaulted(noise, (config.sigma_position**2,) * 3 + (config.sigma_rotation**2,) * 3)
    if (whole := tilted(context, frame)) is not None:
        turn = np.kron(np.eye(2), whole.rotation().matrix())
        noise = turn @ noise @ turn.T
        if not np.isfinite(value).all() or not np.isfinite(noise).all() or np.linalg.eigvalsh(noise)[0] <= 0:
            raise Unusable(
                "not_finite", "a tilted sensor needs x, y and z, and a covariance of all six axes, or none"
            )
        value, mount = np.asarray(SPATIAL.seven(whole.compose(SPATIAL.pose(value.tolist())))), space.identity
    x, y, _ = SPATIAL.pose(value.tolist()).rotation().matrix()[:, 0]
    if space.name == "2d" and hypot(x, y) < UPRIGHT:
        raise Unusable(
            "steep", "the x axis of the tag is not level, so it has no yaw; set 'orientation: false'"
        )
    pose = space.pose(value.tolist())
    exact = np.zeros((space.dimension,) * 2)
    tag = Motion(mount, exact).then(Motion(pose, space.covariance(noise, pose)))
    return tag if motion is None else motion.then(tag)
