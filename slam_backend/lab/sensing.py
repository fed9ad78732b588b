"""What the sensors of a simulated robot say: the truth with exactly the noise that their covariances state."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ..core.geometry import covariance_to_ros, inverse_of, seven_of_matrix
from ..core.measurement import SECOND, Array, frozen
from ..core.sensors.gnss import Fix, geodetic
from ..core.sensors.landmark import LandmarkObservation
from ..core.sensors.odometry import STILL, UNKNOWN, OdometryPose
from ..core.sensors.relative import RelativePose
from .options import Options
from .world import chain, exp_of

BASE = "base"
ANTENNA = "antenna"
ORIGIN = (48.7, 9.1, 400.0)  # of the map on the earth: degrees, degrees, m
CAMERA = "camera"  # the frame of the sensor that sees landmarks
LOOP_AFTER = 50  # messages: what was seen more recently is motion, not a return
LANDMARKS_EVERY = 5  # odometry messages
AXES: Mapping[str, slice] = {  # of azimuth, elevation, range: what a form tells
    "bearing_range": slice(0, 3), "bearing": slice(0, 2), "range": slice(2, 3),
}  # fmt: skip
HALF_VIEW = np.pi / 3  # rad, of a camera to either side


class Loop(NamedTuple):
    """Poses i < j by index; `wrong`: j stands at another place than i, and the measurement says otherwise."""

    i: int
    j: int
    wrong: bool
    measured: Array  # (4, 4) what was measured, before noise


def step_sigmas(steps: Array, options: Options) -> tuple[Array, Array]:
    """Standard deviations (N,) m and (N,) rad of (N, 4, 4) steps: variances grow with path and with rotation."""
    path = np.linalg.norm(steps[:, :3, 3], axis=1)
    sine = np.linalg.norm(
        steps[:, [2, 0, 1], [1, 2, 0]] - steps[:, [1, 2, 0], [2, 0, 1]], axis=1
    )  # the cosine alone loses small angles
    turned = np.arctan2(sine, np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1)
    translation = (
        options.sigma_translation_per_meter**2 * path + options.sigma_translation_per_radian**2 * turned
    )
    rotation = options.sigma_rotation_per_meter**2 * path + options.sigma_rotation_per_radian**2 * turned
    return np.sqrt(translation), np.sqrt(rotation)


def axes_of(space: str) -> Array:
    """(6,) ones on the axes of GTSAM's tangent on which this space errs."""
    return np.array([0.0, 0, 1, 1, 1, 0]) if space == "2d" else np.ones(6)


def drifted(steps: Array, options: Options, space: str, rng: Generator) -> Array:
    """(N - 1, 4, 4) true steps as odometry measures them, perturbed at the tangent of their end; (N, 4, 4) poses."""
    translation, rotation = step_sigmas(steps, options)
    sigmas = np.repeat(np.stack([rotation, translation], axis=1), 3, axis=1) * axes_of(space)
    return chain(steps @ exp_of(rng.standard_normal(sigmas.shape) * sigmas))


def odometry(poses: Array, stamps: list[int], options: Options) -> Iterator[OdometryPose]:
    """(N, 4, 4) poses as messages; the twist is the step that ends at each, over its time, with its covariance."""
    steps = np.concatenate([np.eye(4)[None], inverse_of(poses[:-1]) @ poses[1:]])
    translation, rotation = step_sigmas(steps, options)
    sevens, turned = seven_of_matrix(poses), seven_of_matrix(steps)
    half = np.linalg.norm(turned[:, 3:6], axis=1)
    scale = np.where(half > 1e-8, 2 * np.arctan2(half, turned[:, 6]) / np.maximum(half, 1e-300), 2.0)
    twists = np.concatenate([turned[:, :3], turned[:, 3:6] * scale[:, None]], axis=1) / options.period
    variances = np.repeat(np.stack([translation, rotation], axis=1) ** 2, 3, axis=1) / options.period**2
    for k, stamp in enumerate(stamps):
        covariance = frozen(np.diag(variances[max(k, 1)]).reshape(36))  # zero would say: unknown
        yield OdometryPose(
            stamp, "wheels", "odom", BASE, frozen(sevens[k]), UNKNOWN, frozen(twists[k]), covariance
        )


def truth_messages(truth: Array, stamps: list[int]) -> Iterator[OdometryPose]:
    """(N, 4, 4) true poses as messages in the frame `map`."""
    for stamp, seven in zip(stamps, seven_of_matrix(truth), strict=True):
        yield OdometryPose(stamp, "truth", "map", BASE, frozen(seven), UNKNOWN, STILL, UNKNOWN)


def find_loops(truth: Array, options: Options, rng: Generator) -> list[Loop]:
    """Returns to a place: within range, looking the same way, noticed at the detection rate.

    A wrong loop is a true one told of the wrong place: an old pose more than five ranges away.
    """
    noticed = rng.random(len(truth)) < options.loop_rate
    confused = rng.random(len(truth)) < options.wrong_loop_rate
    choice = rng.random(len(truth))
    positions, ahead = truth[:, :3, 3], truth[:, :3, 0]
    found = []
    for j in np.flatnonzero(noticed[LOOP_AFTER:]) + LOOP_AFTER:
        old = slice(0, j - LOOP_AFTER + 1)
        distance = np.linalg.norm(positions[old] - positions[j], axis=1)
        near = np.flatnonzero((distance < options.loop_range) & (ahead[old] @ ahead[j] > 0))
        pool = np.flatnonzero(distance > 5 * options.loop_range) if confused[j] else near
        if len(near) and len(pool):
            seen = near[int(choice[j] * len(near))]
            i = pool[int(choice[j] * len(pool))]
            measured = inverse_of(truth[seen]) @ truth[j]
            found.append(Loop(int(i), int(j), bool(confused[j]), measured))
    return found


def loop_messages(
    loops: Sequence[Loop], stamps: list[int], options: Options, space: str, rng: Generator
) -> Iterator[RelativePose]:
    """Relative poses `i_T_j`, perturbed at the tangent of j."""
    sigmas = np.repeat([options.loop_sigma_rotation, options.loop_sigma_translation], 3)
    noise = exp_of(rng.standard_normal((len(loops), 6)) * sigmas * axes_of(space))
    for loop, error in zip(loops, noise, strict=True):
        pose = loop.measured @ error
        covariance = covariance_to_ros(np.diag(sigmas**2), pose[:3, :3])
        ti, tj = stamps[loop.i], stamps[loop.j]
        yield RelativePose(
            tj + round(options.loop_delay * 1e9), "loops", ti, tj, BASE, BASE,
            frozen(seven_of_matrix(pose)), frozen(covariance.reshape(36)),
        )  # fmt: skip


def sightings(
    truth: Array, landmarks: Array, camera: Array | None, stamps: list[int], options: Options, rng: Generator
) -> Iterator[tuple[LandmarkObservation, ...]]:
    """All landmarks in range and view of the (4, 4) camera in the base, or all around the base, at every fifth pose."""
    frame, form = BASE if camera is None else CAMERA, options.landmark_form
    sensors = truth[::LANDMARKS_EVERY] @ (np.eye(4) if camera is None else camera)
    sigmas = np.array([options.landmark_sigma_bearing] * 2 + [options.landmark_sigma * options.range_scale])
    sigmas = sigmas[AXES[form]] if form in AXES else np.full(3, options.landmark_sigma)
    covariance = frozen(np.diag(sigmas**2))
    for stamp, sensor in zip(stamps[::LANDMARKS_EVERY], sensors, strict=True):
        points = (landmarks - sensor[:3, 3]) @ sensor[:3, :3]
        visible = np.linalg.norm(points, axis=1) < options.landmark_range
        if camera is not None:
            visible &= np.abs(np.arctan2(points[:, 1], points[:, 0])) < HALF_VIEW
        ids = np.flatnonzero(visible)
        noise = rng.standard_normal((len(ids), 3))
        seen = points[ids] if form not in AXES else _polar(points[ids], options.range_scale)[:, AXES[form]]
        seen = seen + sigmas * noise[:, : len(sigmas)]
        if len(ids):
            yield tuple(
                LandmarkObservation(stamp, "landmarks", frame, str(n), form, frozen(value), covariance)
                for n, value in zip(ids, seen, strict=True)
            )


def _polar(points: Array, scale: float) -> Array:
    """(N, 3) points to azimuth, elevation and range."""
    x, y, z = points.T
    return np.stack(
        [np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), scale * np.linalg.norm(points, axis=1)], axis=1
    )


def arm_of(options: Options) -> Array:
    """(3,) m of the antenna in the base."""
    return options.gnss_arm * np.array([1.0, -0.5, 2.0])


def on_earth(options: Options) -> Array:
    """(4, 4) `earth_T_map`: the map lies level at ORIGIN, turned."""
    return exp_of(np.array([0.0, 0.0, options.gnss_yaw, 0.0, 0.0, 0.0]))


def fixes(truth: Array, stamps: list[int], options: Options, rng: Generator) -> Iterator[Fix]:
    """Where the antenna of (N, 4, 4) true poses is on the earth, with noise; none during the outage."""
    poses = on_earth(options) @ truth[:: options.gnss_every]
    antennas = poses[:, :3, :3] @ arm_of(options) + poses[:, :3, 3]
    noisy = antennas + options.gnss_sigma * rng.standard_normal(antennas.shape)
    covariance = frozen(np.eye(3) * options.gnss_sigma**2)
    begin = stamps[0] + round(options.gnss_outage_start * SECOND)
    silent = range(begin, begin + round(options.gnss_outage * SECOND))
    for stamp, place in zip(stamps[:: options.gnss_every], geodetic(noisy, ORIGIN), strict=True):
        if stamp not in silent:
            yield Fix(stamp, "gps", ANTENNA, frozen(place), covariance)
