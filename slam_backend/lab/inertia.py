"""The IMU of a simulated robot: what it feels along the true poses, gravity included, with noise and biases that walk."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ..core.geometry import inverse_of
from ..core.measurement import SECOND, Array, ImuSample, frozen
from .options import Options
from .world import exp_of

GRAVITY = np.array((0.0, 0.0, -9.81))
UNSTATED = frozen(np.zeros(9))


class Felt(NamedTuple):
    """Of M samples: stamps (M,) ns, each at the end of what it holds for; rates and accelerations (M, 3) in the base."""

    stamps: list[int]
    rates: Array
    accelerations: Array


def felt(truth: Array, stamps: Sequence[int], rate: float) -> Felt:
    """Without noise, along a smooth path through (N, 4, 4) poses at equal distances in time: a cubic spline for the position, constant
    rates of turn from one pose to the next. About `rate` samples per second, a whole number from pose to pose.
    """
    period = (stamps[1] - stamps[0]) / SECOND
    share = max(1, round(period * rate))
    dt, count = period / share, (len(stamps) - 1) * share
    velocity = velocities(truth[:, :3, 3], period, share)
    acceleration = np.diff(velocity, axis=0) / dt - GRAVITY
    turns = _log(inverse_of(truth[:-1]) @ truth[1:]) / period  # (N - 1, 3)
    begin = np.arange(count) % share * dt  # since the pose before
    tangents = np.zeros((count, 6))
    tangents[:, :3] = np.repeat(turns, share, axis=0) * begin[:, None]
    rotations = np.repeat(truth[:-1, :3, :3], share, axis=0) @ exp_of(tangents)[:, :3, :3]
    ends = [stamps[0] + round((k + 1) * dt * SECOND) for k in range(count)]
    return Felt(ends, np.repeat(turns, share, axis=0), np.einsum("nji,nj->ni", rotations, acceleration))


def imu_messages(
    truth: Array, stamps: Sequence[int], options: Options, frame: str, rng: Generator
) -> Iterator[ImuSample]:
    """What `felt` gives, with the errors of `erring`."""
    exact = felt(truth, stamps, options.imu_rate)
    dt = (exact.stamps[1] - exact.stamps[0]) / SECOND
    bias, white = erring(len(exact.stamps), dt, options, rng)
    measured = np.concatenate([exact.accelerations, exact.rates], axis=1) + bias + white
    for stamp, numbers in zip(exact.stamps, measured, strict=True):
        yield ImuSample(stamp, "imu", frame, frozen(numbers[3:]), frozen(numbers[:3]), UNSTATED, UNSTATED)


def erring(count: int, dt: float, options: Options, rng: Generator) -> tuple[Array, Array]:
    """(count, 6) bias that walks and (count, 6) white noise, accelerations first as in GTSAM's bias; dt: s between samples."""
    density, walk, bias = (
        np.repeat([getattr(options, f"{part}_{what}") for part in ("accelerometer", "gyroscope")], 3)
        for what in ("density", "walk", "bias")
    )
    steps = rng.standard_normal((count, 6)) * walk * np.sqrt(dt)
    white = rng.standard_normal((count, 6)) * density / np.sqrt(dt)
    return rng.standard_normal(6) * bias + np.cumsum(steps, axis=0), white


def velocities(points: Array, period: float, share: int) -> Array:
    """((N - 1) share + 1, 3) of the cubic spline through (N, 3) points, at equal distances in time; not accelerated at its ends."""
    second = _second_derivatives(points, period)
    at = np.arange(share) / share
    slopes = np.diff(points, axis=0)[:, None] / period
    first, last = second[:-1, None], second[1:, None]
    a, b = (1 - at)[None, :, None], at[None, :, None]
    inside = slopes - period / 6 * ((3 * a**2 - 1) * first - (3 * b**2 - 1) * last)
    end = slopes[-1, 0] + period / 6 * (second[-2] + 2 * second[-1])
    return np.concatenate([inside.reshape(-1, 3), end[None]])


def _second_derivatives(points: Array, period: float) -> Array:
    """(N, 3) at the knots; zero at the ends. A tridiagonal system, 1 4 1 in each row, by elimination."""
    right = 6 / period**2 * np.diff(points, 2, axis=0)
    pivots = np.full(len(right), 4.0)
    for k in range(1, len(right)):
        pivots[k] -= 1 / pivots[k - 1]
        right[k] -= right[k - 1] / pivots[k - 1]
    second = np.zeros((len(points), 3))
    for k in range(len(right) - 1, -1, -1):
        second[k + 1] = (right[k] - second[k + 2]) / pivots[k]
    return second


def _log(poses: Array) -> Array:
    """(N, 4, 4) to (N, 3) rotation vectors, of less than half a turn."""
    skew = poses[:, [2, 0, 1], [1, 2, 0]] - poses[:, [1, 2, 0], [2, 0, 1]]
    sine = np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1)
    return skew * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 0.5)[:, None]
