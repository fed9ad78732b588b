"""Every decision is on record, floods are counted, and the last word about a loop is what counts."""

import json

from slam_backend.core.decisions import DecisionLog, as_json
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND


def decided(
    stamp=1, id_="wheels/x", verdict="refused", stage="check", reason="nan", source="wheels", **more
) -> Decision:
    return Decision(stamp, id_, source, verdict, stage, reason, **more)


def loop(id_, verdict, stage="admit", reason="unjudged", stamp=1) -> Decision:
    return decided(stamp, id_, verdict, stage, reason, "loops", ends=(1, 2))


def log(*decisions) -> DecisionLog:
    made = DecisionLog()
    made.extend(decisions)
    return made


def test_a_flood_is_kept_once_per_rule_source_and_second_with_its_count():
    flood = [decided(stamp=second * SECOND + n) for second in (3, 4) for n in range(1000)]
    told = list(log(*flood, decided(3 * SECOND, reason="inf"), decided(3 * SECOND, source="visual")))
    assert [d.count for d in told] == [1000, 1000, 1, 1]
    assert told[0].stamp == 3 * SECOND
    assert log(*flood).by_rule() == {"check/nan": 2000}


def test_decisions_about_factors_are_all_kept_in_order():
    several = [loop(f"loops/1/{n}", "accepted") for n in range(5)]
    assert list(log(*several)) == several
    assert len(log(*several)) == 5


def test_rules_are_counted_by_name_in_order():
    made = log(
        decided(), decided(stage="settle", reason="late"), decided(stage="admit", reason="gate"), decided()
    )
    assert list(made.by_rule().items()) == [("admit/gate", 1), ("check/nan", 2), ("settle/late", 1)]


def test_the_last_verdict_on_a_loop_is_what_holds():
    made = log(
        loop("a", "probation"), loop("b", "accepted"), loop("a", "accepted"), loop("b", "removed"), decided()
    )
    assert made.loops() == {"accepted": 1, "removed": 1}


def test_loops_refused_before_they_were_factors_all_count():
    """A batch of one stamp: the record is refused, under one id, for reasons of several kinds."""
    batch = [loop("loops/5", "refused", "check", reason) for reason in ("nan", "nan", "quaternion")]
    assert log(*batch, loop("loops/5/0", "accepted")).loops() == {"refused": 3, "accepted": 1}


def test_a_line_says_stamps_exactly_and_is_json():
    told = loop("loops/1.5/0", "accepted", stamp=1_500_000_001)
    line = as_json(told)
    assert json.loads(json.dumps(line)) == line
    assert (line["stamp"], line["a"], line["b"]) == ("1.500000001", "0.000000001", "0.000000002")
    assert (line["id"], line["verdict"], line["stage"], line["reason"]) == (
        "loops/1.5/0",
        "accepted",
        "admit",
        "unjudged",
    )
    assert "count" not in line
    assert "a" not in as_json(decided())
    assert as_json(decided(count=3, statistic=2.5, threshold=1.0))["count"] == 3
