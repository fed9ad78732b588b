"""One table, in whose words everything is said."""

import pytest

from slam_backend.core.firewall.rules import RULES, rule_of
from slam_backend.core.graph import Decision


@pytest.mark.parametrize("id_", RULES)
def test_every_rule_says_what_is_wrong_and_what_to_do(id_: str) -> None:
    rule = RULES[id_]
    assert rule.severity in ("note", "warn", "error")
    assert len(rule.what) > 10
    assert len(rule.advice) > 10
    assert not rule.what.endswith(".")
    assert "|" not in rule.what + rule.advice


def test_a_rule_is_found_for_whatever_kind_of_source() -> None:
    assert rule_of("landmark/unknown_frame") is RULES["*/unknown_frame"]
    assert rule_of("check/not_finite") is RULES["check/not_finite"]
    assert rule_of("admit/unjudged") is None


def test_a_decision_speaks_in_the_words_of_its_rule() -> None:
    from slam_backend.core.firewall.rules import decided
    from slam_backend.core.measurement import SECOND, Measurement

    told = decided(Measurement(SECOND, "wheels"), "refused", "settle/jump", 7.0)
    assert told == Decision(
        SECOND, "wheels/1.000000000", "wheels", "refused", "settle", "jump",
        RULES["settle/jump"].what, 7.0, 1.0,
    )  # fmt: skip
