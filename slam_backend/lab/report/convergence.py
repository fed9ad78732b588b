"""Cost against iteration of the final batch."""

from ..colours import SMOOTHED
from .page import Section, drawn, figure, line, said
from .subject import Subject


def section(run: Subject) -> Section | None:
    batch = run.summary.get("batch")
    if not batch or not batch["iterations"]:
        return None
    costs = [batch["cost_initial"], *(step["cost"] for step in batch["iterations"])]
    trace = {**line("cost", SMOOTHED, list(range(len(costs))), costs), "mode": "lines+markers"}
    drawing = figure([trace], "iteration", "cost (half of chi-square)", height=320)
    body = said(f"From {costs[0]:.6g} to {batch['cost']:.9g}; it ended since {batch['stop']}.")
    return Section("Final batch", body + drawn("convergence"), {"convergence": drawing})
