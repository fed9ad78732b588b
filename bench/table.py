"""A measurement as a row of docs/benchmarks.md."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """ours and baseline with their units; value is what `must` bounds ('<= 1.25', '>= 2.5'); empty: nothing is promised."""

    what: str
    ours: str
    baseline: str
    value: float
    must: str = ""

    @property
    def holds(self) -> bool:
        if not self.must:
            return True
        sign, bound = self.must.split()
        return self.value <= float(bound) if sign == "<=" else self.value >= float(bound)


def markdown(title: str, explanation: str, rows: Iterable[Row]) -> str:
    lines = [
        f"## {title}",
        "",
        explanation,
        "",
        "| what | ours | baseline | value | must |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        bound = f"{row.must}{'' if row.holds else ' **missed**'}" if row.must else ""
        lines.append(f"| {row.what} | {row.ours} | {row.baseline} | {row.value:.5g} | {bound} |")
    return "\n".join(lines) + "\n"
