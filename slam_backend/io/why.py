"""Why a loop is in the graph of a finished run, or is not, and what difference it makes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.errors import BadConfig
from ..core.graph import Factor
from .finished import FinishedRun
from .replay import Run


def life(finished: FinishedRun, name: str) -> list[Mapping[str, Any]]:
    """Every decision about a loop, the last one last. name: its id, or i-j by the vertices of a graph file.

    BadConfig if nothing was decided about it, or if several loops have these vertices.
    """
    about = [line for line in finished.decisions if line["id"] == name]
    if not about and (ends := _vertices(name)):
        about = [line for line in finished.decisions if sorted(line.get("vertices", ())) == ends]
        if len(ids := {line["id"] for line in about}) > 1:
            raise BadConfig(f"{name}: several loops have these ends: {', '.join(sorted(ids))}; name one")
    if not about:
        raise BadConfig(
            f"{finished.path}: nothing was decided about '{name}' (ids are <source>/<sec>.<nsec>/<n>, as in decisions.jsonl)"
        )
    return about


def _vertices(name: str) -> list[int] | None:
    first, dash, second = name.partition("-")
    return sorted((int(first), int(second))) if dash and first.isdigit() and second.isdigit() else None


def difference(run: Run, id_: str) -> dict[str, Any]:
    """Of a run that has been replayed to its end: cost with and without the loop, the largest shift that it makes, its weight.

    Costs are chi2/2 at the optimum of the kept factors, the loop itself counted where it is in. SlamError if it made no factor.
    """
    held: Factor | None = next((f for f in run.result.factors if f.id == id_), None)
    asked = {"disable": [id_]} if held else {"enable": [id_]}
    told = run.backend.dry_run("edit", asked)
    cost = told["cost"]
    found = {
        "cost_with": cost["before"] if held else cost["after"],
        "cost_without": cost["after"] if held else cost["before"],
        "largest_shift": told["largest_shift"],
    }
    return found if held is None else {**found, **_weighed(held, run)}


def _weighed(loop: Factor, run: Run) -> dict[str, Any]:
    """Its squared distance at the estimate, and what its kernel, if it has one, makes of it."""
    noise = loop.factor.noiseModel()
    residual = loop.factor.unwhitenedError(run.result.values)
    inner = noise.noise() if hasattr(noise, "noise") else noise
    distance = float(np.sum(np.square(inner.whiten(residual))))
    weight = float(noise.robust().weight(np.sqrt(distance))) if hasattr(noise, "robust") else 1.0
    return {"residual_chi2": distance, "weight": weight}
