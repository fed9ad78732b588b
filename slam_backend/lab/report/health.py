"""What the firewall refused or remarked on, by rule."""

from .page import Section, said, table
from .subject import Subject

ORDINARY = frozenset({"admit/unjudged"})


def section(run: Subject) -> Section:
    first: dict[str, str] = {}
    for each in run.decisions:
        first.setdefault(
            f"{each['stage']}/{each['reason']}", f"{each['verdict']}: {each.get('detail', '')} ({each['id']})"
        )
    rows = [
        (rule, n, first.get(rule, "")) for rule, n in run.summary["decisions"].items() if rule not in ORDINARY
    ]
    if not rows:
        return Section("Input health", said("Every message was taken as it came."))
    return Section("Input health", table(("rule", "how often", "the first"), rows))
