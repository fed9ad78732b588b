"""Why it is fast: the information matrix, and its square root in two orders of elimination."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import gtsam
import numpy as np

from ...core.trajectory import Stamps
from .page import Figure, Section, drawn, figure, numbers, said, table
from .subject import Subject

BINS = 240
NATURAL = 3_000  # variables beyond which the order of time, with fill-in nearly as their square, is not tried
INK = [[0, "white"], [1e-9, "#b9c8e6"], [1, "#1f4e9c"]]


def section(run: Subject) -> Section | None:
    rank = {
        key: n for n, key in enumerate(dict.fromkeys(key for each in run.linearized.keys for key in each))
    }
    pairs = np.array(
        [(rank[a], rank[b]) for each in run.linearized.keys for a, b in combinations(dict.fromkeys(each), 2)],
        dtype=np.int64,
    )
    if not len(pairs):
        return None
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    graph = gtsam.SymbolicFactorGraph()
    for a, b in pairs.tolist():
        graph.push_factor(a, b)
    size = len(rank)
    for n in range(size):  # those that stand alone, too
        graph.push_factor(n)
    blocks = len(pairs) + size
    diagonal = np.tile(np.arange(size)[:, None], 2)
    whole = np.vstack([pairs, pairs[:, ::-1], diagonal])
    figures = {"information": _spy(whole, np.arange(size), "information matrix, in order of time")}
    rows = []
    for name, ordering, title in _orders(graph, size):
        net = _eliminated(graph, ordering)
        filled, cliques = sum(map(len, net)), np.array(_cliques(net))
        numbers_of = f"{cliques.mean():.1f}", int(cliques.max())
        rows.append((title, f"{filled:,}", f"{filled / blocks:.2f}", len(cliques), *numbers_of))
        square = np.column_stack(
            [np.repeat([each[0] for each in net], [len(each) for each in net]), np.concatenate(net)]
        )
        place = np.empty(size, dtype=np.int64)
        place[[each[0] for each in net]] = np.arange(len(net))
        figures[name] = _spy(square, place, f"square root, {title}")
    body = said(
        f"{size:,} variables, {blocks:,} blocks in the information matrix. Eliminating them fills in blocks; a good order keeps them few."
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


def _orders(graph: gtsam.SymbolicFactorGraph, size: int) -> Iterator[tuple[str, gtsam.Ordering, str]]:
    if size <= NATURAL:
        in_time = gtsam.Ordering()
        for n in range(size):
            in_time.push_back(n)
        yield "in_time", in_time, "in order of time"
    yield "colamd", gtsam.Ordering.ColamdSymbolicFactorGraph(graph), "COLAMD"


def _eliminated(graph: gtsam.SymbolicFactorGraph, ordering: gtsam.Ordering) -> list[list[int]]:
    """The variables of each conditional, its own first, in the order of elimination."""
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


def _spy(pairs: Stamps, place: Stamps, title: str) -> Figure:
    """Where the blocks (row, column) are, counted in at most BINS x BINS cells. place: of each variable."""
    size = len(place)
    cells = min(size, BINS)
    counts = np.zeros((cells, cells), dtype=np.int64)
    np.add.at(counts, tuple((place[pairs] * cells // size).T), 1)
    full = max(float(np.percentile(counts[counts > 0], 95)), 1.0)
    shade = np.ceil(np.minimum(counts / full, 1.0) * 255).astype(np.uint8)
    along = numbers(np.arange(cells) * size // cells)
    trace = {
        "type": "heatmap", "z": {**numbers(shade), "shape": f"{cells}, {cells}"}, "x": along, "y": along,
        "colorscale": INK, "zmin": 0, "zmax": 255, "showscale": False, "hoverinfo": "skip",
    }  # fmt: skip
    drawing = figure([trace], "variable", "variable", equal=True, height=340)
    drawing["layout"]["yaxis"]["autorange"] = "reversed"
    drawing["layout"]["title"] = {"text": title, "font": {"size": 13}}
    drawing["layout"]["margin"]["t"] = 60  # below the buttons
    return drawing
