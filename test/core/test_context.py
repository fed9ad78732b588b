"""What sensors may ask, and how one says that a measurement makes no factor."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam_backend.core.context import Context, Unusable, defaulted, each
from slam_backend.core.graph import Factor, Offer, Wait
from slam_backend.core.measurement import Measurement
from slam_backend.core.mounts import Mounts
from slam_backend.core.space import SPACES

FLAT = SPACES["2d"]


def context() -> Context:
    mounts = Mounts(FLAT, "base_link", {"laser": (1, 2, 0, 0, 0, 0.5)})
    nothing = {"place": lambda _: None, "motion": None, "landmark": None, "component": None}
    return Context(FLAT, None, {7: gtsam.Pose2(1, 2, 3)}, mounts, **nothing)


def test_first_guesses_come_before_the_estimate():
    class Believed:
        def pose(self, key):
            return gtsam.Pose2(key, 0, 0)

    known = replace(context(), estimate=Believed())
    assert known.pose(7).equals(gtsam.Pose2(1, 2, 3), 0)
    assert known.pose(8).equals(gtsam.Pose2(8, 0, 0), 0)


def test_an_unknown_frame_and_an_uncovered_stamp_are_unusable():
    assert context().mount("laser").equals(gtsam.Pose2(1, 2, 0.5), 1e-12)
    assert context().mount("base_link") is FLAT.identity
    with pytest.raises(Unusable, match="where is 'camera'") as caught:
        context().mount("camera")
    assert caught.value.reason == "unknown_frame"
    with pytest.raises(Unusable) as caught:
        context().landing(5)
    assert caught.value.reason == "uncovered"


def test_each_measurement_becomes_a_factor_a_wait_or_a_decision():
    window = [Offer(f"tags/1/{n}", Measurement(n + 1, "tags")) for n in range(3)]

    def make(offer):
        if offer.id.endswith("1"):
            raise Unusable("range", "too near")
        if offer.id.endswith("2"):
            return Wait(offer, 5, "later")
        return Factor(offer.id, "landmark", None, (1, 2), 1)

    delta = each(window, "landmark", make)
    assert [factor.id for factor in delta.add] == ["tags/1/0"]
    assert [wait.offer.id for wait in delta.waits] == ["tags/1/2"]
    (decision,) = delta.decisions
    assert (decision.id, decision.source, decision.stamp) == ("tags/1/1", "tags", 2)
    assert (decision.verdict, decision.stage, decision.reason, decision.detail) == (
        "refused", "landmark", "range", "too near",
    )  # fmt: skip


def test_variances_that_are_zero_or_nan_are_replaced_with_what_correlates_with_them():
    defaults = (9.0, 16.0, 25.0)
    full = np.array([[1.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 1.0]])
    assert defaulted(full, defaults) is full
    zero, nan = full.copy(), full.copy()
    zero[1, 1] = 0.0
    nan[1, :] = nan[:, 1] = np.nan
    for partly in (zero, nan):
        np.testing.assert_array_equal(
            defaulted(partly, defaults), [[1.0, 0.0, 0.1], [0.0, 16.0, 0.0], [0.1, 0.0, 1.0]]
        )
    np.testing.assert_array_equal(defaulted(np.zeros((3, 3)), defaults), np.diag(defaults))
    assert zero[1, 1] == 0.0
