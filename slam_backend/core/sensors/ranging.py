"""Ranges: how far a landmark is from the sensor, and from how many sightings without a distance or a direction its place follows."""

import numpy as np

from ..config import LandmarkSource
from ..context import Context
from ..graph import Decision, Factor, Offer, Pose, Verdict
from ..keyframes import Placed
from ..measurement import Array
from ..robust.kernels import noise_of
from .placing import AMBIGUOUS, Place, Sighting

PLACELESS = frozenset({"range", "bearing"})  # forms of which one sighting cannot place a landmark


def range_factor(
    offer: Offer, placed: Placed, mount: Pose, seen: tuple[Array, Array], key: int, point: Array | None,
    context: Context, config: LandmarkSource,
) -> Factor:  # fmt: skip
    """The native factor with the sensor where it was, seen from the keyframe; what the motion since then may err along the line
    of sight is added to the variance. point: where the landmark is believed to be, for the direction of
    the line; not needed where the sensor was at the keyframe.
    """
    (value, covariance), space, pose_key = seen, context.space, placed.keyframe.pose
    if placed.motion is None:
        sensor, noise = mount, covariance
    else:
        assert point is not None
        motion = placed.motion
        sensor = motion.pose.compose(mount)
        of_pose = np.zeros((space.point_dimension, space.dimension), order="F")
        there = motion.pose.transformFrom(
            mount.translation(), of_pose, np.zeros((space.point_dimension,) * 2, order="F")
        )
        line = context.pose(pose_key).transformTo(point) - there
        along = line / max(float(np.linalg.norm(line)), 1e-9) @ of_pose
        noise = covariance + along @ motion.covariance @ along
    factor = space.observe_range(pose_key, key, float(value[0]), noise_of(noise, config), sensor)
    return Factor(offer.id, "landmark", factor, (pose_key, key), offer.measurement.stamp)


def sighting(form: str, seen: tuple[Array, Array], placed: Placed, mount: Pose, context: Context) -> Sighting:
    """A range or a bearing as what the search for the place takes."""
    (value, covariance), space = seen, context.space
    sensor = placed.motion.pose.compose(mount) if placed.motion else mount
    pose = context.pose(placed.keyframe.pose).compose(sensor)
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if form == "range":
        return Sighting(pose, placed.keyframe.pose, float(value[0]), sigma, None, 0.0)
    elevation = float(value[1]) if len(value) > 1 else 0.0
    return Sighting(pose, placed.keyframe.pose, None, 0.0, space.direction(float(value[0]), elevation), sigma)


def told(newest: Offer, landmark: str, place: Place, count: int) -> Decision:
    """What became of an attempt to place a landmark from so many sightings."""
    m = newest.measurement
    places = [[round(float(axis), 3) for axis in each] for each in place.others]
    basis = {"landmark": landmark, "sightings": count, "sigma": place.sigma, "places": places}
    if place.point is None:
        verdict: Verdict = "probation"
        reason, detail = (
            "undetermined" if len(places) < 2 else "ambiguous",
            f"landmark {landmark}: {place.why}",
        )
    else:
        verdict, reason = "accepted", "placed"
        detail = f"landmark {landmark}: {count} sightings place it to within {place.sigma:.2g} m"
    return Decision(
        m.stamp,
        f"{m.source}/{landmark}",
        m.source,
        verdict,
        "placing",
        reason,
        detail,
        place.margin,
        AMBIGUOUS,
        basis=basis,
    )
