"""GNSS: a position on the earth. How the map lies there is unknown until the path has told: `map_T_earth`, key EARTH.

Earth is the frame east, north, up at an origin: that of the configuration, else the first fix. Once the fixes lie far enough apart
to tell the yaw, the earth takes the place of the first pose as what holds the graph: `map_T_earth` stays at the first guess, and the
trajectory, now free, turns and shifts to fit. That is the same estimate as a free `map_T_earth` beside a first pose that is
held, at a fifteenth of the cost: a variable that every fix touches would be in every clique. It is free all the same where
something else holds the map (absolute poses, a map that is continued).

gtsam has no native factor for an antenna beside the base, nor for an earth that is free. A prior on the pose, or a between factor
from the earth, is one whose information about the rotation is zero: its measured pose is the fix, turned as the pose is
believed to be. Its error is zero exactly where the antenna is at the fix; elsewhere its length is off by the cosine of half the angle
between belief and truth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, pi, sin, sqrt

import gtsam
import numpy as np
import pymap3d

from ..config import GnssSource
from ..context import Context, Unusable, each
from ..graph import DATUM, EARTH, UNTIL_JOINED, Decision, Delta, Factor, Keyframe, Motion, Offer, Pose, Wait
from ..measurement import Array, Decoder, Measurement, Message, format_stamp, frozen, stamp_of
from ..robust.kernels import noise_of, with_kernel
from ..space import Space

UNKNOWN, DIAGONAL = 0, 2  # of position_covariance_type; 1 is approximated, 3 known as a whole
SEEN = 64  # fixes that the first guess looks at, however many wait
BROAD = 100.0  # m; of where the robot is on the earth, before the fixes are used
SURE = 1e-4  # m and rad; of the earth in the map, where it holds the graph
ROUNDS = 10  # of reweighting
MISFIT = 3.0  # standard deviations by which the better half of the fixes may lie aside,
SLIP = 0.2  # and m per m of odometry beside
HIGHEST = 1e6  # m above the ellipsoid, of any receiver
JOINED = (
    "the fixes tell where this part of the map lies on the earth, which another part knows: they are one now"
)


@dataclass(frozen=True, slots=True, eq=False)
class Fix(Measurement):
    """Where the antenna, which is at `frame` of the robot, is.

    place: (3,) latitude and longitude in degrees WGS-84, m above the ellipsoid. status: of NavSatStatus, -1: no fix.
    covariance: (3, 3) east, north, up in m^2; zero or NaN on the diagonal: use the configured default.
    """

    frame: str
    place: Array
    covariance: Array
    status: int = 0


def decode(message: Message, source: str) -> Fix:
    """sensor_msgs/msg/NavSatFix."""
    covariance = np.array(message.position_covariance, dtype=np.float64).reshape(3, 3)
    if message.position_covariance_type == UNKNOWN:
        covariance = np.zeros((3, 3))
    elif message.position_covariance_type == DIAGONAL:
        covariance = np.diag(np.diag(covariance))
    place = frozen((message.latitude, message.longitude, message.altitude))
    frame = message.header.frame_id.lstrip("/")
    return Fix(stamp_of(message), source, frame, place, frozen(covariance), int(message.status.status))


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/NavSatFix": decode}


def grounded(fix: Fix, space: Space) -> Fix:
    """As the space uses it: in the plane the height is not looked at, and some receivers tell NaN there, or nonsense."""
    if space.point_dimension == 3 or abs(fix.place[2]) < HIGHEST:
        return fix
    return replace(fix, place=frozen((fix.place[0], fix.place[1], 0.0)))


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,
    context: Context,
    config: GnssSource,
) -> Delta:
    """A factor per fix, on the keyframe; until the yaw of the earth can be told, the fixes wait for it."""
    known, apart = context.known(EARTH), context.apart(b.pose, EARTH)
    if known and not apart:
        return each(window, "gnss", lambda offer: _factor(offer, context, config))
    until = UNTIL_JOINED if apart else EARTH
    fixes = [*(wait.offer for wait in context.waiting(until)), *window]
    found = _first_guess(_sights(fixes, b, context, config), context)
    if isinstance(found, str):
        return each(window, "gnss", lambda offer: _held(offer, until, found, context))
    if apart:
        return _joined(found, window, b, context)
    gauge = context.gauge(b.pose)
    laid = (_laid(found, b, context), *([] if gauge is None else [_datum(found, b, context)]))
    context = replace(context, guesses={**context.guesses, EARTH: found}, has_datum=gauge is not None)
    delta = each(window, "gnss", lambda offer: _factor(offer, context, config))
    remove = () if gauge is None else (gauge,)
    return replace(delta, add=(*laid, *delta.add), remove=remove, values={EARTH: found})


def _held(offer: Offer, until: int, why: str, context: Context) -> Wait:
    """It waits, unless it will never be of use: an antenna that nobody has mounted."""
    m = offer.measurement
    assert isinstance(m, Fix)
    context.mount(m.frame)
    return Wait(offer, until, why)


def _joined(guess: Pose, window: Sequence[Offer], b: Keyframe, context: Context) -> Delta:
    """The earth is known in another part of the graph: this one is moved to where its fixes lie there, and all that waited goes in
    then. guess: `map_T_earth` as this part would have it.
    """
    name = window[0].measurement.source
    laid = _laid(guess, b, context)
    laid = replace(laid, id=f"{laid.id}:{name}")  # another receiver may say the same at this keyframe
    told = Decision(b.stamp, laid.id, name, "accepted", "gnss", "joined", JOINED)
    waits = tuple(Wait(offer, UNTIL_JOINED, "used as soon as the two parts are one") for offer in window)
    return Delta((laid,), waits=waits, decisions=(told,))


def enu(places: Array, origin: Sequence[float]) -> Array:
    """(..., 3) m east, north and up of the origin; both in degrees and m."""
    return np.array(pymap3d.geodetic2enu(*places.T, *origin)).T


def geodetic(points: Array, origin: Sequence[float]) -> Array:
    """The inverse of `enu`."""
    return np.array(pymap3d.enu2geodetic(*points.T, *origin)).T


def _factor(offer: Offer, context: Context, config: GnssSource) -> Factor | Wait:
    m, space = offer.measurement, context.space
    assert isinstance(m, Fix)
    assert context.origin is not None
    placed, arm = context.landing(m.stamp), context.mount(m.frame).translation()
    key, size = placed.keyframe.pose, space.point_dimension
    if context.apart(key, EARTH):
        return Wait(offer, UNTIL_JOINED, "the earth belongs to a part of the graph that is not connected yet")
    keyframe_T_base = placed.motion.pose if placed.motion else space.identity
    keyframe_T_antenna = keyframe_T_base.compose(space.rigid(np.eye(size), arm))
    map_T_earth = context.pose(EARTH)
    turned = map_T_earth.between(context.pose(key)).compose(keyframe_T_antenna).rotation()
    measured = space.rigid(turned.matrix(), enu(m.place, context.origin)[:size])
    covariance = turned.matrix().T @ stated(m, config)[:size, :size] @ turned.matrix()
    if placed.motion:
        covariance += _of_motion(placed.motion, arm)
    # The tangent of the error is at the keyframe; that of the noise at the antenna, where only translations are measured.
    rows = keyframe_T_antenna.inverse().AdjointMap()[space.translation]
    root = np.zeros((space.dimension,) * 2)
    root[:size] = gtsam.noiseModel.Gaussian.Covariance(covariance).R() @ rows
    noise = with_kernel(gtsam.noiseModel.Gaussian.SqrtInformation(root, False), config)
    measured = measured.compose(keyframe_T_antenna.inverse())
    if context.has_datum:
        prior = space.prior(key, map_T_earth.compose(measured), noise)
        return Factor(offer.id, "gnss", prior, (key,), m.stamp)
    return Factor(offer.id, "gnss", space.between(EARTH, key, measured, noise), (key, EARTH), m.stamp)


def stated(m: Fix, config: GnssSource) -> Array:
    """(3, 3) of the message, zeros and NaN replaced by the defaults, never more certain than the floor."""
    if all(0 < each >= config.sigma_floor**2 for each in m.covariance.diagonal().tolist()):
        return m.covariance
    variances = np.diag(m.covariance)
    known = variances > 0
    covariance = np.where(known[:, None] & known, m.covariance, 0.0)
    usual = np.array([config.sigma_horizontal, config.sigma_horizontal, config.sigma_vertical]) ** 2
    floor = config.sigma_floor**2
    np.fill_diagonal(covariance, np.where(known, np.maximum(variances, floor), usual))
    return np.asarray(covariance)


def _of_motion(motion: Motion, arm: Array) -> Array:
    """Of the antenna's position in its own axes, from the noise of the motion since the keyframe."""
    size = len(arm)
    of_pose = np.zeros((size, len(motion.covariance)), order="F")
    motion.pose.transformFrom(arm, of_pose, np.zeros((size, size), order="F"))
    of_pose = motion.pose.rotation().matrix().T @ of_pose
    return np.asarray(of_pose @ motion.covariance @ of_pose.T)


def _sights(offers: Sequence[Offer], b: Keyframe, context: Context, config: GnssSource) -> Array:
    """(N, 9) of some of the fixes in the part of b: antenna by odometry in the map, antenna by the fix, standard deviation, all in m; then x and y of
    the direction that the base looks in.
    """
    rows = []
    fixes = [offer.measurement for offer in offers if isinstance(offer.measurement, Fix)]
    for m in fixes[:: -(-len(fixes) // SEEN) or 1]:
        assert context.origin is not None
        try:
            placed, mount = context.landing(m.stamp), context.mount(m.frame)
        except Unusable:
            continue
        if context.apart(placed.keyframe.pose, b.pose):
            continue
        pose = context.pose(placed.keyframe.pose)
        pose = pose.compose(placed.motion.pose) if placed.motion else pose
        antenna = np.zeros(3)
        antenna[: context.space.point_dimension] = pose.transformFrom(mount.translation())
        sigma = sqrt(np.trace(stated(m, config)[:2, :2]) / 2)
        ahead = pose.rotation().matrix()[:2, 0]
        rows.append((*antenna, *enu(m.place, context.origin), sigma, *ahead))
    return np.array(rows).reshape(-1, 9)


def _first_guess(sights: Array, context: Context) -> Pose | str:
    """map_T_earth that lays the fixes onto the odometry; or why that cannot be told yet."""
    settings = context.earth
    if not len(sights):
        return "no fix has a place on the trajectory yet"
    antenna, fixes, sigma = sights[:, :3], sights[:, 3:6], float(np.median(sights[:, 6]))
    points = _headed(fixes, sights[:, 7:]) if context.by_imu else antenna[:, :2]
    if settings.yaw is not None:
        yaw, weights = -settings.yaw, np.ones(len(sights))
    else:
        # A receiver that stands still tells nothing, whatever the odometry does.
        reach = min(float(np.linalg.norm(path - path[0], axis=1).max()) for path in (points, fixes[:, :2]))
        needed = max(settings.baseline, sqrt(2) * sigma / settings.yaw_within)
        if reach < needed:
            return (
                f"yaw not yet observable: the fixes reach over {reach:.1f} m, and {needed:.1f} m are needed"
            )
        yaw, weights = _aligned(points, fixes[:, :2], sigma)
    c, s = cos(yaw), sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    shift = np.average(antenna - fixes @ turn.T, axis=0, weights=weights)
    beside = points - (fixes @ turn.T)[:, :2]
    beside -= np.average(beside, axis=0, weights=weights)
    away = float(np.median(np.linalg.norm(beside, axis=1)))
    if settings.yaw is None and away > MISFIT * sigma + SLIP * reach:
        return (
            f"yaw not yet observable: half of the fixes lie {away:.1f} m and more beside the odometry's path"
        )
    size = context.space.point_dimension
    return context.space.rigid(turn[:size, :size], shift[:size])


def _headed(fixes: Array, ahead: Array) -> Array:
    """(N, 2) a path from fix to fix, as far as they lie apart and where the base looks: an IMU knows directions, but not how fast
    it was when it began.
    """
    lengths = np.linalg.norm(np.diff(fixes[:, :2], axis=0), axis=1)
    steps = lengths[:, None] * (ahead[:-1] + ahead[1:]) / 2
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _aligned(points: Array, fixes: Array, sigma: float) -> tuple[float, Array]:
    """The yaw (rad) that turns (N, 2) fixes onto (N, 2) points, by least squares reweighted after Cauchy; the weights (N,)."""
    weights = np.ones(len(points))
    for _ in range(ROUNDS):
        p = points - np.average(points, axis=0, weights=weights)
        f = fixes - np.average(fixes, axis=0, weights=weights)
        across = weights @ (f[:, 0] * p[:, 1] - f[:, 1] * p[:, 0])
        yaw = atan2(across, weights @ (f * p).sum(axis=1))
        c, s = cos(yaw), sin(yaw)
        away = np.hypot(p[:, 0] - c * f[:, 0] + s * f[:, 1], p[:, 1] - s * f[:, 0] - c * f[:, 1])
        weights = 1 / (1 + (away / (2 * sigma)) ** 2)
    return yaw, weights


def _laid(guess: Pose, b: Keyframe, context: Context) -> Factor:
    """What is known of the earth beforehand: its vertical, and no more. The noise is at the robot, not at an origin that may be
    far away.
    """
    settings, space = context.earth, context.space
    yaw = pi if settings.yaw is None else settings.sigma_yaw
    variances = np.diag(space.diagonal(yaw**2, BROAD**2)).copy()
    if space.name == "3d":
        variances[:2] = settings.sigma_level**2
    factor = space.between(EARTH, b.pose, guess.between(context.pose(b.pose)), noise_of(np.diag(variances)))
    return Factor(f"earth/{format_stamp(b.stamp)}/0", "earth", factor, (b.pose, EARTH), b.stamp)


def _datum(guess: Pose, b: Keyframe, context: Context) -> Factor:
    """Holds the earth where it is, instead of the first pose."""
    noise = noise_of(context.space.diagonal(SURE**2, SURE**2))
    return Factor(DATUM, "datum", context.space.prior(EARTH, guess, noise), (EARTH,), b.stamp)
