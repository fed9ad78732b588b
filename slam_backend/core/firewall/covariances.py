"""Covariances: only the block that the space uses is judged, and each matrix once: robots repeat them."""

from functools import lru_cache

import numpy as np

from ..measurement import Array, frozen
from .rules import ABSURD_VARIANCE, ASYMMETRY, TINY_VARIANCE, Fault

Notes = tuple[str, ...]  # reasons of rules about what is kept
NOTHING: Notes = ()
CAPPED = "covariance_capped"
CIRCLE = np.pi**2  # rad^2: the variance of a rotation of which nothing is known is smaller
PLACEHOLDER = 1e3  # m^2 or rad^2: from here on a variance is meant as "unknown"


def judge_covariance(ros: Array, used: tuple[int, ...]) -> Notes:
    """(36,) in ROS order. Fault if no factor can come of it; a zero variance asks for the configured default."""
    return _said(_verdict(ros.tobytes(), used))


def judge_noise(covariance: Array, used: tuple[int, ...]) -> Notes:
    """(n, n) of a sighting. NaN on the diagonal, too, asks for the default; without any noise stated there is no note."""
    return _said(_verdict_of_sighting(covariance.tobytes(), len(covariance), used))


def judge_information(matrix: Array) -> Notes:
    _judge_definite(matrix, "information")
    return NOTHING


def capped(covariance: Array) -> Array:
    """The same, where a variance beyond ABSURD_VARIANCE is that, and correlated with nothing."""
    size = 6 if covariance.ndim == 1 else len(covariance)
    matrix = covariance.reshape(size, size).copy()
    huge = np.diag(matrix) > ABSURD_VARIANCE
    matrix[huge] = matrix[:, huge] = 0.0
    matrix[huge, huge] = ABSURD_VARIANCE
    return frozen(matrix.reshape(covariance.shape))


@lru_cache(maxsize=4096)
def _verdict(raw: bytes, used: tuple[int, ...]) -> Notes | Fault:
    whole = np.frombuffer(raw).reshape(6, 6)
    block = whole[np.ix_(used, used)]
    try:
        _judge(block)
    except Fault as fault:
        return fault
    diagonal = np.diag(whole)
    if _is_swapped(diagonal, used):
        return ("covariance_swapped",)
    return _notes(np.diag(block))


@lru_cache(maxsize=4096)
def _verdict_of_sighting(raw: bytes, size: int, used: tuple[int, ...]) -> Notes | Fault:
    block = np.frombuffer(raw).reshape(size, size)[np.ix_(used, used)]
    diagonal = np.diag(block)
    if np.isnan(diagonal).all() or not diagonal.any():
        return NOTHING
    unknown = np.isnan(diagonal)
    try:
        _judge(np.where(np.isnan(block) & (unknown[:, None] | unknown), 0.0, block))
    except Fault as fault:
        return fault
    return _notes(diagonal)


def _said(verdict: Notes | Fault) -> Notes:
    if isinstance(verdict, Fault):
        raise verdict.with_traceback(None)  # else it would grow with each raise
    return verdict


def _notes(diagonal: Array) -> Notes:
    zero = ("zero_covariance",) if (diagonal == 0).any() else NOTHING
    return (*zero, CAPPED) if (diagonal > ABSURD_VARIANCE).any() else zero


def _is_swapped(diagonal: Array, used: tuple[int, ...]) -> bool:
    """Whether rotation seems to come first, as in GTSAM. A planar robot shows it by what is zero; any other by rotations less
    certain than a full circle, yet no placeholders, beside translations that are known better.
    """
    planar = not diagonal[[0, 1, 5]].any() and bool((diagonal[[2, 3, 4]] > 0).all())
    first, second = diagonal[:3], diagonal[3:]
    spatial = len(used) == 6 and bool(
        (second > CIRCLE).all()
        and (second < PLACEHOLDER).all()
        and (first > 0).all()
        and (first < CIRCLE).all()
    )
    return planar or spatial


def _judge(block: Array) -> None:
    diagonal = np.diag(block)
    if not np.isfinite(block).all():
        raise Fault("covariance_not_finite")
    if (diagonal < 0).any():
        raise Fault("covariance_negative", float(diagonal.min()))
    if (diagonal >= ABSURD_VARIANCE).all():
        raise Fault("covariance_absurd", float(diagonal.min()))
    known = diagonal > 0
    if known.any() and (smallest := float(diagonal[known].min())) < TINY_VARIANCE:
        raise Fault("covariance_tiny", smallest)
    largest = float(np.abs(block).max())
    with np.errstate(over="ignore"):
        skew = float(np.abs(block - block.T).max())
    if skew > ASYMMETRY * largest:
        raise Fault("covariance_asymmetric", skew / largest)
    if block[~known].any():
        raise Fault("covariance_indefinite")
    if known.any():
        _judge_definite(block[np.ix_(known, known)], "covariance")


def _judge_definite(matrix: Array, what: str) -> None:
    """Positive definite, judged on the scale of each axis, since m^2 and rad^2 differ by decades."""
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all():
        raise Fault(f"{what}_not_finite")
    if (diagonal <= 0).any():
        raise Fault(f"{what}_indefinite", float(diagonal.min()))
    scale = np.sqrt(diagonal)
    with np.errstate(over="ignore"):
        scaled = matrix / scale[:, None] / scale
    if (
        largest := float(np.abs(scaled).max())
    ) > 1 + ASYMMETRY:  # no correlation is; eigenvalues may not converge
        raise Fault(f"{what}_indefinite", 1 - largest)
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if not smallest > 0:
        raise Fault(f"{what}_indefinite", smallest)
