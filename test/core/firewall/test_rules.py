"""One table: every rule that the code names is in it, and every rule in it is named by the code."""

import re
from pathlib import Path

import pytest

from slam_backend.core.firewall import rules
from slam_backend.core.firewall.rules import RULES, rule_of
from slam_backend.core.graph import Decision

PACKAGE = Path(__file__).parents[3] / "slam_backend"
SOURCE = "\n".join(
    path.read_text()
    for path in (*PACKAGE.rglob("core/**/*.py"), PACKAGE / "io/cdr.py")
    if path != Path(rules.__file__)
)


def named() -> set[str]:
    """Ids as they stand in the code that judges."""
    found = set(re.findall(r'"((?:check|settle|recheck|wait|imu|gnss|coast)/[a-z_]+)"', SOURCE))
    found |= {f"check/{reason}" for reason in re.findall(r'Fault\(\s*"([a-z_]+)"', SOURCE)}
    for what in re.findall(r'Fault\(\s*f"\{what\}_([a-z_]+)"', SOURCE):
        found |= {f"check/covariance_{what}", f"check/information_{what}"}
    found |= {
        f"check/{note}"
        for note in re.findall(r'"(zero_covariance|covariance_swapped|covariance_capped)"', SOURCE)
    }
    found |= {f"doubt/{reason}" for reason in re.findall(r'"(unexpected|alone)"', SOURCE)}
    found |= {f"decode/{reason}" for reason in re.findall(r'"(bad_message|unknown_type|oversize)"', SOURCE)}
    return found | {
        f"*/{reason}" for reason in re.findall(r'"(unknown_frame|uncovered|no_camera|off_keyframe)"', SOURCE)
    }


def test_the_table_and_the_code_name_the_same_rules() -> None:
    assert named() == set(RULES)


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
