"""What the publishers of a recorded topic offered: rosbag2 keeps it as YAML, in numbers or words by version."""

from typing import Any

import yaml

RELIABILITY = {1: "reliable", 2: "best_effort"}  # of rmw_qos_reliability_policy_t
DURABILITY = {1: "transient_local", 2: "volatile"}


def offered_qos(text: str) -> str:
    """`reliable, volatile` and the like: the weakest of all publishers; empty where it is not said."""
    try:
        profiles: Any = yaml.safe_load(text)
    except yaml.YAMLError:
        return ""
    words = [
        _weakest(profiles, "reliability", RELIABILITY, "best_effort"),
        _weakest(profiles, "durability", DURABILITY, "volatile"),
    ]
    return ", ".join(word for word in words if word)


def _weakest(profiles: Any, policy: str, names: dict[int, str], weak: str) -> str:
    if not isinstance(profiles, list):
        return ""
    said = [p[policy] for p in profiles if isinstance(p, dict) and isinstance(p.get(policy), int | str)]
    words = {names.get(each, "") if isinstance(each, int) else each.lower() for each in said}
    words &= set(names.values())
    return weak if weak in words else next(iter(words), "")
