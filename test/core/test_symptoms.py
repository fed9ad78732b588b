"""Symptoms of an IMU, each by the samples that show it."""

import numpy as np
import pytest

from slam_backend.core.config import ImuSource
from slam_backend.core.measurement import SECOND, ImuSample, frozen
from slam_backend.core.symptoms import TURNS, Symptoms

STEP = SECOND // 100
UNSTATED = frozen(np.zeros(9))


def sample(n: int, up: float = 9.81, rate: float = 0.0) -> ImuSample:
    return ImuSample(
        n * STEP, "imu", "", frozen([0.0, 0.0, rate]), frozen([0.0, 0.0, up]), UNSTATED, UNSTATED
    )


def compared(symptoms: Symptoms, ups: list[float]) -> list[float | None]:
    samples = [sample(n, up) for n, up in enumerate(ups)]
    return [
        symptoms.compare(each, before) for before, each in zip([samples[0], *samples], samples, strict=False)
    ]


def test_the_same_numbers_for_over_a_second_are_told_once():
    told = [each for each in compared(Symptoms(ImuSource(topic="/imu")), [9.81] * 400) if each is not None]
    assert told == [pytest.approx(1.01)]


def test_a_straight_line_that_is_not_level_is_no_measurement_once_it_is_longer_than_a_gap():
    config = ImuSource(topic="/imu", max_gap=0.2)
    for steepness, count, flaw in ((0.01, 30, "imu/interpolated"), (0.01, 15, ""), (0.0, 30, "")):
        symptoms = Symptoms(config)
        compared(symptoms, [9.81 + steepness * n for n in range(count)])
        assert symptoms.flaw(sample(count)) == flaw


@pytest.mark.parametrize(
    ("settings", "flaw"), [({"max_rate": 2.0}, "imu/saturated"), ({"max_rate": 2.5}, ""), ({}, "")]
)
def test_the_end_of_the_range_is_where_the_configuration_says(settings, flaw):
    assert Symptoms(ImuSource(topic="/imu", **settings)).flaw(sample(0, rate=-2.0)) == flaw


def test_rates_in_degrees_show_in_turns_until_enough_have_fitted():
    rates = [frozen([0.0, 0.0, 0.5])] * 50
    wrong = [frozen(np.degrees(rate)) for rate in rates]
    symptoms = Symptoms(ImuSource(topic="/imu"))
    symptoms.compare_turns(wrong, 0.5, 0.01)
    assert not symptoms.in_degrees  # no turn
    symptoms.compare_turns(wrong, 0.5, 0.25)
    assert symptoms.in_degrees
    for _ in range(TURNS):
        assert symptoms.doubts_turns
        symptoms.compare_turns(rates, 0.5, 0.25)
        assert not symptoms.in_degrees
    assert not symptoms.doubts_turns
