"""Conditions on the numbers of runs: arithmetic and comparisons, and a clear line for everything else."""

import pytest

from slam_backend.core.errors import BadConfig
from slam_backend.lab.condition import Condition

KNOWN = {"ate": "m", "cost": "", "flips": ""}
HERE, BASE = {"ate": 1.2, "cost": 30.0, "flips": 0.0}, {"ate": 1.0, "cost": 40.0, "flips": 0.0}


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("ate > 1.05 * base", True),
        ("ate > 1.25 * base", False),
        ("1.1 < ate / base <= 1.2", True),
        ("cost > base", False),
        ("cost > base.cost or ate > base.ate", True),
        ("not (cost < base.cost) and ate > base.ate", False),
        ("not flips == 0", False),
        ("ate - base.ate > -(0.1 - 0.2)", True),
        ("flips != base", False),
    ],
)
def test_it_compares_a_run_with_its_base(text, holds):
    assert Condition(text, KNOWN).holds(HERE, BASE) is holds


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("atee > base", "there is no 'atee'; did you mean 'ate'\\? known: ate, cost, flips"),
        ("base.atee > 1", "there is no 'atee'"),
        ("ate >", "is no condition"),
        ("", "is no condition"),
        ("(" * 5000, "is no condition"),
        ("ate", "compares nothing"),
        ("ate + 1", "compares nothing"),
        ("ate > cost * base", "which number of the base\\? write for instance base.ate"),
        ("ate > 2 ** 99", "is neither a number"),
        ("ate > 'x'", "is neither a number"),
        ("ate > abs(-1)", "there is no 'abs'"),
        ("ate.real > 1", "there is no 'real'"),
        ("ate[0] > 1", "is neither a number"),
        ("ate > 1 if cost > 2 else 3", "compares nothing"),
        ("[ate for x in cost] > 1", "there is no 'x'"),
        ("ate in cost", "is neither a number"),
        ("__import__('os').system('true') > 1", "there is no '__import__'"),
    ],
)
def test_what_is_no_condition_is_named_before_any_work(text, why):
    with pytest.raises(BadConfig, match=why) as error:
        Condition(text, KNOWN)
    assert "\n" not in str(error.value)


def test_numbers_that_are_missing_or_divide_by_zero_are_said():
    with pytest.raises(BadConfig, match=r"'ate' is not known .* --truth"):
        Condition("ate > 1", KNOWN).holds({**HERE, "ate": None}, BASE)
    with pytest.raises(BadConfig, match="divides by zero"):
        Condition("ate / base.flips > 1", KNOWN).holds(HERE, BASE)
