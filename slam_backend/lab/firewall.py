"""docs/firewall.md, from the table of rules: `python -m slam_backend.lab.firewall > docs/firewall.md`."""

import sys

from ..core.firewall.rules import RULES, Rule

HEAD = """# Firewall

Written by `make docs` from the table in `core/firewall/rules.py`. The live node, `slam-backend replay` and `slam-backend doctor` judge by
these rules; each refusal is a line in `decisions.jsonl`, a message on `~/decisions`, and counted on `/diagnostics`.

The id is `stage/reason` as in decisions; `*` stands for the kind of the source. Severity: a **note** costs nothing; **warn**: messages are
lost or weakened; **error**: the source is of no use until it is mended. What a decision states as `statistic` is compared with the threshold;
where a setting is named, the threshold is that setting's default.

Nothing is judged that the configuration does not use: in the plane only x, y and yaw; of an odometry's covariances only the one that `noise`
names. A covariance of all zeros means the configured default. The **driving source** (the first odometry, else the IMU, else the first relative source, else the first GNSS or absolute pose) is
protected: no other source moves the watermark, and of a flood the oldest messages of the flooding source are dropped, never those of the driving one.
"""
STAGES = {
    "decode": "Bytes to measurements",
    "check": "What a message tells alone",
    "settle": "Stamps, in order of arrival",
    "recheck": "Odometry, in order of stamps",
    "wait": "While waiting for a keyframe",
    "imu": "From one keyframe to the next, by the IMU",
    "coast": "Where nothing measures the motion",
    "*": "Where it lands",
    "relative": "Relative poses",
    "landmark": "Landmarks and tags",
    "placing": "Landmarks seen by range or bearing alone",
    "association": "Landmarks without ids",
    "quarantine": "Landmarks beside their own history",
    "budget": "What a landmark may cost",
    "pixels": "Pixels of a frame",
    "points": "Points in the graph",
    "gnss": "Fixes on the earth",
    "doubt": "Fixes beside what is expected of them",
    "calibration": "Constants of the sensors",
}


def page() -> str:
    lines = [HEAD]
    for stage, title in STAGES.items():
        rules = {id_: rule for id_, rule in RULES.items() if id_.partition("/")[0] == stage}
        lines += [
            f"## {title}",
            "",
            "| id | severity | what | threshold | what to do |",
            "|---|---|---|---|---|",
        ]
        lines += [
            f"| `{id_}` | {rule.severity} | {rule.what} | {_threshold(rule)} | {rule.advice} |"
            for id_, rule in rules.items()
        ]
        lines.append("")
    return "\n".join(lines)


def _threshold(rule: Rule) -> str:
    if rule.threshold is None:
        return ""
    number = f"{rule.threshold:g} {rule.unit}".strip()
    return f"{number} (`{rule.setting}`)" if rule.setting else number


if __name__ == "__main__":
    sys.stdout.write(page())
