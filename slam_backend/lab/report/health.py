"""What the firewall remarked on or refused, and what to do about it; then the verdicts of all later stages."""

from ...core.firewall.rules import rule_of
from .page import Section, said, table
from .subject import Subject
from .verdicts import ENTERED

ORDER = ("error", "warn", "note")


def section(run: Subject) -> Section:
    first: dict[str, str] = {}
    for each in run.decisions:
        first.setdefault(f"{each['stage']}/{each['reason']}", f"{each['id']}: {each.get('detail', '')}")
    counts = {rule: n for rule, n in run.summary["decisions"].items() if rule not in ENTERED}
    known = {id_: rule for id_ in counts if (rule := rule_of(id_)) is not None}
    judged = [
        (rule.severity, id_, counts[id_], rule.what, rule.advice, first.get(id_, ""))
        for id_, rule in sorted(known.items(), key=lambda item: ORDER.index(item[1].severity))
    ]
    later = [(id_, n, first.get(id_, "")) for id_, n in counts.items() if id_ not in known]
    body = said("Every message was taken as it came.")
    if judged:
        body = table(("severity", "rule", "how often", "what", "what to do", "the first"), judged)
    if later:
        body += "<h3>Later stages</h3>" + table(("rule", "how often", "the first"), later)
    return Section("Input health", body)
