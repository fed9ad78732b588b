"""Why it is fast: the information matrix, and its square root in two orders of elimination."""

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from ...core.measurement import Array
from ...io.rundir import FinishedRun
from .page import Section, drawn, figure, numbers, said, table

BINS = 240
INK = [[0, "white"], [1e-9, "#b9c8e6"], [1, "#1f4e9c"]]


def section(run: FinishedRun) -> Section | None:
    keys = run.linearized.keys
    graph = gtsam.SymbolicFactorGraph()
    rank = {key: n for n, key in enumerate(dict.fromkeys(key for each in keys for key in each))}
    joint = [[rank[key] for key in each] for each in keys if len(set(each)) > 1]
    if not joint:
        return None
    for each in joint:
        for first, second in pairwise(each):
            graph.push_factor(first, second)
        if len(each) > 2:
            graph.push_factor(each[0], each[-1])
    variables = sorted({key for each in joint for key in each})
    in_time, colamd = gtsam.Ordering(), gtsam.Ordering.ColamdSymbolicFactorGraph(graph)
    for key in variables:
        in_time.push_back(key)
    blocks = len({tuple(sorted(pair)) for each in joint for pair in pairwise(each)}) + len(variables)
    figures, rows = {}, []
    pairs = np.array([(a, b) for each in joint for a in each for b in each])
    figures["information"] = _spy(pairs, variables, "information matrix, in order of time")
    for name, ordering, title in (("in_time", in_time, "in order of time"), ("colamd", colamd, "COLAMD")):
        net = _eliminated(graph, ordering)
        filled = sum(map(len, net))
        sizes = np.array(_cliques(net))
        rows.append(
            (
                title,
                f"{filled:,}",
                f"{filled / blocks:.2f}",
                len(sizes),
                f"{sizes.mean():.1f}",
                int(sizes.max()),
            )
        )
        square = np.array([(each[0], other) for each in net for other in each])
        figures[name] = _spy(square, [each[0] for each in net], f"square root, {title}")
    body = said(
        f"{len(variables):,} variables, {blocks:,} blocks in the information matrix. Eliminating them fills in blocks; a good order keeps them few."
    )
    head = (
        "order",
        "blocks of the square root",
        "fill-in",
        "cliques of the Bayes tree",
        "mean size",
        "largest",
    )
    spies = "".join(f'<div style="flex:1 1 300px;min-width:0">{drawn(name)}</div>' for name in figures)
    return Section("Sparsity", f'{body}{table(head, rows)}<div class="bar">{spies}</div>', figures)


def _eliminated(graph: gtsam.SymbolicFactorGraph, ordering: gtsam.Ordering) -> list[list[int]]:
    """The keys of each conditional, its own first, in the order of elimination."""
    net = graph.eliminateSequential(ordering)
    return [list(net.at(n).keys()) for n in range(net.size())]


def _cliques(net: Sequence[Sequence[int]]) -> list[int]:
    """Sizes of the cliques of the Bayes tree (Kaess et al., IJRR 2012): from the root on, a variable joins the clique of the first
    of its parents if that clique holds nothing else.
    """
    clique_of: dict[int, int] = {}
    sizes: list[int] = []
    place = {each[0]: n for n, each in enumerate(net)}
    for each in reversed(net):
        parents = each[1:]
        above = clique_of[min(parents, key=place.__getitem__)] if parents else None
        if above is not None and sizes[above] == len(parents):
            sizes[above] += 1
            clique_of[each[0]] = above
        else:
            clique_of[each[0]] = len(sizes)
            sizes.append(len(each))
    return sizes


def _spy(pairs: Array, order: Sequence[int], title: str) -> dict[str, object]:
    """Where the blocks are, counted in at most BINS x BINS cells."""
    place = {key: n for n, key in enumerate(order)}
    size = len(order)
    cells = min(size, BINS)
    where = np.array([[place[a], place[b]] for a, b in pairs.tolist()]) * cells // size
    counts = np.zeros((cells, cells), dtype=np.int64)
    np.add.at(counts, (where[:, 0], where[:, 1]), 1)
    full = max(float(np.percentile(counts[counts > 0], 95)), 1.0)
    shade = np.ceil(np.minimum(counts / full, 1.0) * 255).astype(np.uint8)
    trace = {
        "type": "heatmap", "z": {**numbers(shade), "shape": f"{cells}, {cells}"}, "x": numbers(np.arange(cells) * size // cells),
        "y": numbers(np.arange(cells) * size // cells), "colorscale": INK, "zmin": 0, "zmax": 255, "showscale": False, "hoverinfo": "skip",
    }  # fmt: skip
    drawing = figure([trace], "variable", "variable", equal=True, height=340)
    drawing["layout"]["yaxis"]["autorange"] = "reversed"
    drawing["layout"]["title"] = {"text": title, "font": {"size": 13}}
    drawing["layout"]["margin"]["t"] = 60  # below the buttons
    return drawing
