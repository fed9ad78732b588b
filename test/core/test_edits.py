"""What a person wishes of factors: how they are named, and what wishes add up to."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from slam_backend.core.edits import Edit, Wishes, edit_of, selected, weighted, weights_of
from slam_backend.core.errors import BadConfig, SlamError
from slam_backend.core.graph import Factor
from slam_backend.core.measurement import SECOND


def factor(id_, kind="loop"):
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.2, 0.3]))
    stamp = int(id_.split("/")[1].split(".")[0]) * SECOND
    return Factor(id_, kind, gtsam.BetweenFactorPose2(X(0), X(1), gtsam.Pose2(), noise), (X(0), X(1)), stamp)


FACTORS = [
    factor("loops/10.000000000/0"),
    factor("loops/20.000000000/0"),
    factor("gps/20.000000000/0", "pose"),
    factor("odometry/20.000000000/0", "motion"),
]


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("loops/10.000000000/0", 1),
        ("loops", 2),
        ("odometry", 1),
        ("all", 3),
        ("loops@15,", 1),
        ("loops@,15.5", 1),
        ("loops@10,20", 2),
        ("all@20,20", 2),
    ],
)
def test_factors_are_named_by_id_by_source_and_by_time(name, count):
    assert len(selected(name, FACTORS)) == count


@pytest.mark.parametrize(
    ("name", "error", "why"),
    [
        ("loops/11.000000000/0", SlamError, "decision/loops/11"),
        ("lops", SlamError, "no factors of 'lops'"),
        ("loops@30,40", SlamError, "between 30.000000000 and 40"),
        ("loops@now,40", BadConfig, "'now' is not a stamp"),
    ],
)
def test_a_name_that_fits_nothing_says_so(name, error, why):
    with pytest.raises(error, match=why):
        selected(name, FACTORS)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"disable": []},
        {"disable": "loops"},
        {"disable": [1]},
        {"explode": ["loops"]},
        {"reweight": ["loops"]},
        {"reweight": {"loops": 0.0}},
        {"reweight": {"loops": float("nan")}},
        {"reweight": {"loops": True}},
    ],
)
def test_what_is_no_edit_is_refused(arguments):
    with pytest.raises(BadConfig):
        edit_of(arguments)


def test_a_reweighting_is_written_with_an_equals_sign():
    assert weights_of(["loops/1.5/0=0.25", "gps=4"]) == {"loops/1.5/0": 0.25, "gps": 4.0}
    for text in ("gps", "gps=", "=4", "gps=much"):
        with pytest.raises(BadConfig, match="NAME=FACTOR"):
            weights_of([text])


def test_wishes_add_up_and_the_last_one_counts():
    one, two = FACTORS[0].id, FACTORS[1].id
    wishes = Edit(disable=["loops"]).applied(Wishes(), FACTORS)
    assert wishes.out == {one: "disabled", two: "disabled"}
    wishes = Edit(enable=[one], reweight={one: 0.5}).applied(wishes, FACTORS)
    assert (wishes.out, wishes.forced, wishes.weights) == ({two: "disabled"}, {one}, {one: 0.5})
    wishes = Edit(disable=[one]).applied(wishes, FACTORS)
    assert (wishes.forced, wishes.out[one]) == (frozenset(), "disabled")


def test_an_edit_that_contradicts_itself_is_refused():
    with pytest.raises(SlamError, match="named twice"):
        Edit(disable=["loops"], enable=[FACTORS[1].id]).applied(Wishes(), FACTORS)


def test_what_has_been_removed_cannot_be_enabled():
    wishes = Edit(remove=["gps"]).applied(Wishes(), FACTORS)
    with pytest.raises(SlamError, match="undo brings it back"):
        Edit(enable=["gps"]).applied(wishes, FACTORS)


@pytest.mark.parametrize("kernel", [None, gtsam.noiseModel.mEstimator.Huber.Create(1.3)])
def test_a_weight_multiplies_the_information(kernel):
    """Twice the standard deviation is a weight of a quarter: the whitened error halves, within a kernel too."""
    plain = FACTORS[0]
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose2())
    values.insert(X(1), gtsam.Pose2(0.03, -0.02, 0.01))
    if kernel is not None:
        noise = gtsam.noiseModel.Robust.Create(kernel, plain.factor.noiseModel())
        robust = plain.factor.cloneWithNewNoiseModel(noise)
        plain = Factor(plain.id, plain.kind, robust, plain.keys, plain.stamp)
    light = weighted(plain, 0.25)
    assert light.factor.error(values) == pytest.approx(plain.factor.error(values) / 4)
    assert isinstance(light.factor.noiseModel(), type(plain.factor.noiseModel()))
    assert weighted(plain, 1.0) is plain
