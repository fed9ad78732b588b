"""The run hash: one number that is equal when two runs did the same, bit for bit."""

import json
from collections.abc import Iterable
from hashlib import sha256

import gtsam

from .decisions import as_json
from .graph import Decision, Factor
from .measurement import Array


def run_hash(
    factors: Iterable[Factor], decisions: Iterable[Decision], values: gtsam.Values, sevens: Array
) -> str:
    """SHA-256 over the factors, the decisions and the final poses.

    A factor counts by its id, its variables, and its whitened Jacobian and residual at the final values, which hold its
    measurement and its noise. Decisions are sorted, since those about single records stand in the order of arrival.
    """
    digest = sha256()
    for factor in sorted(factors, key=lambda factor: factor.id):
        digest.update(f"{factor.id} {factor.kind} {factor.keys} ".encode())
        digest.update(factor.factor.linearize(values).augmentedJacobian().tobytes())
    for line in sorted(json.dumps(as_json(decision)) for decision in decisions):
        digest.update(line.encode())
    digest.update(sevens.astype("<f8").tobytes())
    return digest.hexdigest()
