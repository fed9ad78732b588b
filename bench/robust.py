"""Wrong loops: every strategy on real and on injected ones, beside what one would write with gtsam alone.

python -m bench robust                        what is promised, on a subset; some minutes
python -m bench.robust [--all] [--keep F]     every strategy on a subset or on everything (hours), into docs/robust.md
"""

import json
import sys
from argparse import ArgumentParser
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bench.loops import GRAPHS, Case, aliased, injected, vo_loops
from bench.strategies import Found, ours, played, strategies
from bench.table import Row, markdown
from slam_backend.core.backend import Backend
from slam_backend.core.config import Config
from slam_backend.core.robust.chi2 import chi2_quantile
from slam_backend.core.sensors.relative import RelativePose

TITLE = "Wrong loops"
EXPLANATION = (
    "What is promised of the default configuration; worst of the data sets named. Precision, recall and wrong loops: of loops "
    "that are off by more than 10 m or 20 deg (KITTI), or that were added (graphs; shares are of all loops). At any moment: of the causal run. All strategies "
    "and baselines on each data set: [robust.md](robust.md)."
)
PAGE = Path(__file__).parents[1] / "docs/robust.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
FRAMES = 50  # keyframes after which a loop that waited must have entered
LONE = {"witness": {"lone": 0.95}}
GROUPS, SIZE = 45, 5  # of wrong loops that agree, in each of two drives
SHARES = (0.0, 0.1, 0.3, 0.5)
SUBSET: dict[str, Any] = {"alphas": ("0.15",), "seeds": (None, 1)}
Results = dict[str, dict[str, Found]]  # strategy -> case -> what came of it


def rows(whole: bool = False) -> list[Row]:
    """What is promised. whole: on all data sets instead of some."""
    some = {} if whole else SUBSET
    found: list[Row] = []
    for sequence in ("00", "05"):
        found += _promised(sequence, list(vo_loops((sequence,), **some)))
    found += _alone(list(vo_loops(("07",), **some)))
    for name, bound in (("intel", "<= 0.05"), ("M3500", "<= 0.2")):
        found += _random(name, bound)
    return found + list(_aliasing())


def _promised(sequence: str, these: list[Case]) -> Iterator[Row]:
    if not these:
        return
    name = f"KITTI {sequence}, {len(these)} data sets"
    runs = [ours(case, {}) for case in these]
    yield from _kept(name, runs, 0.98)
    ratio, run, case = max(
        ((r.ate / c.ate_clean, r, c) for r, c in zip(runs, these, strict=True)), key=lambda t: t[0]
    )
    yield Row(
        f"{name}: ATE",
        f"{run.ate:.2f} m",
        f"{case.ate_clean:.2f} m with exactly the true loops",
        ratio,
        "<= 1.05",
    )
    prompt, slowest = min(r.prompt for r in runs), max(r.slowest for r in runs)
    yield Row(f"{name}: accepted at arrival", f"{prompt:.1%}", "", prompt, ">= 0.85")
    yield Row(f"{name}: slowest of the rest", f"{slowest:.0f} keyframes", "", slowest, f"<= {FRAMES}")
    scale = Config().gate.odometry_scale
    for factor in (1 / 3, 3.0):
        runs = [ours(case, {"gate": {"odometry_scale": factor * scale}}) for case in these]
        yield from _kept(f"{name}, odometry noise x {factor:.2g}", runs, 0.95)


def _kept(name: str, runs: list[Found], recall: float) -> Iterator[Row]:
    ever = max(r.ever for r in runs)
    yield Row(f"{name}: wrong loops kept at any moment", f"{ever:.0f}", "", ever, "<= 0")
    least = min(r.recall for r in runs)
    yield Row(f"{name}: recall", f"{least:.1%}", "", least, f">= {recall}")


def _alone(these: list[Case]) -> Iterator[Row]:
    """One or two true loops in the whole drive: nothing speaks for them."""
    if not these:
        return
    name = f"KITTI 07, {len(these)} data sets"
    runs = [ours(case, {}) for case in these]
    ever = max(r.ever for r in runs)
    yield Row(f"{name}: wrong loops kept at any moment", f"{ever:.0f}", "", ever, "<= 0")
    worst = max(zip(runs, these, strict=True), key=lambda pair: pair[0].ate / pair[1].ate_odometry)
    yield _drift(f"{name}: ATE", *worst, "ate_odometry", "of odometry alone")
    told = [
        loop.rule for case in these for loop in played(case, {}).tally.loops.values() if loop.label == "true"
    ]
    unseen = sum(rule == "witness/no_witness" for rule in told) / len(told)
    yield Row(f"{name}: true loops whose verdict is no witness", f"{unseen:.0%}", "", unseen, ">= 1")
    runs = [ours(case, LONE) for case in these]
    ever, least = max(r.ever for r in runs), min(r.recall for r in runs)
    yield Row(f"{name}, lone loops let in: wrong loops kept at any moment", f"{ever:.0f}", "", ever, "<= 0")
    yield Row(f"{name}, lone loops let in: recall", f"{least:.0%}", "", least, ">= 1")
    worst = max(zip(runs, these, strict=True), key=lambda pair: pair[0].ate / pair[1].ate_clean)
    yield _drift(f"{name}, lone loops let in: ATE", *worst, "ate_clean", "with exactly the true loops")


def _drift(name: str, run: Found, case: Case, against: str, what: str) -> Row:
    bound = getattr(case, against)
    return Row(name, f"{run.ate:.2f} m", f"{bound:.2f} m {what}", run.ate / bound, "<= 1.1")


def _random(name: str, bound: str) -> Iterator[Row]:
    clean = injected(name, 0.0)
    if clean is None:
        return
    baseline = ours(clean, {})
    for share in (0.3, 0.5):
        case = injected(name, share)
        assert case is not None
        run = ours(case, {})
        yield Row(
            f"{case.name} ({case.counted}): ATE",
            f"{run.ate:.4f} m",
            f"{baseline.ate:.4f} m clean",
            run.ate,
            bound,
        )
        yield Row(
            f"{case.name}: CPU", f"{run.seconds:.1f} s", f"{baseline.seconds:.1f} s clean", run.seconds / baseline.seconds, "<= 1.5"
        )  # fmt: skip
        if name == "M3500":
            yield Row(f"{case.name}: verdict, p50", f"{run.p50:.1f} ms", "", run.p50, "<= 20")
            yield Row(f"{case.name}: verdict, p99", f"{run.p99:.1f} ms", "", run.p99, "<= 80")


LONE = {"witness": {"lone": 0.95}}
GROUPS, SIZE = 45, 5  # of wrong loops that agree, in each of two drives
SHARES = (0.0, 0.1, 0.3, 0.5)
Results = dict[str, dict[str, Found]]  # strategy -> case -> what came of it


def _aliasing() -> Iterator[Row]:
    """Groups of wrong loops that agree with each other, at random places of two drives."""
    within: list[bool] = []  # of each group inside the noise of the odometry: whether any of it was ever kept
    beyond: list[bool] = []
    for sequence in ("00", "05"):
        if (made := aliased(sequence, GROUPS, SIZE)) is None:
            return
        case, groups = made
        backend, tally, *_ = played(case, {})
        kept = {frozenset(loop.ends) for loop in tally.loops.values() if loop.entered is not None}
        for group in groups:
            entered = any(frozenset(loop.ends) in kept for loop in group)
            (beyond if _contradicted(backend, group) else within).append(entered)
    name = f"KITTI 00 and 05, groups of {SIZE} wrong loops that agree"
    yield Row(
        f"{name}, where odometry contradicts them: accepted",
        f"{sum(beyond)} of {len(beyond)}",
        "",
        sum(beyond),
        "<= 0",
    )
    rate = sum(within) / max(len(within), 1)
    yield Row(
        f"{name}, inside its noise: accepted", f"{sum(within)} of {len(within)}", "nobody can tell", rate
    )


def _contradicted(backend: Backend, group: list[RelativePose]) -> bool:
    """Whether a loop of the group is beyond the noise of the odometry between its ends, scaled as the gate has it."""
    gate, space, paths = backend.config.gate, backend.space, backend._paths  # noqa: SLF001
    limit = chi2_quantile(gate.probability, space.dimension)
    for loop in group:
        a, b = (backend.timeline.at(stamp).pose for stamp in loop.ends)
        path = paths.along(a, b)
        away = space.logmap(path.pose.between(space.pose(loop.pose.tolist())))
        covariance = path.covariance(gate.odometry_scale) + np.linalg.inv(space.information(loop.information))
        if away @ np.linalg.solve(covariance, away) > limit:
            return True
    return False


def cases(whole: bool) -> Iterator[Case]:
    """All, or some that show most."""
    yield from vo_loops() if whole else vo_loops(alphas=("0.15",), seeds=(None, 1))
    for name in GRAPHS if whole else ("intel", "ring"):
        for share in SHARES if whole else (0.3,):
            if (case := injected(name, share)) is not None:
                yield case


def measure(whole: bool, kept: Path | None) -> tuple[Results, dict[str, Case]]:
    """Every strategy on every case. kept: a file that remembers what has been measured, so that it can be broken off."""
    results: Results = {name: {} for name in strategies()}
    for line in kept.read_text().splitlines() if kept and kept.is_file() else ():
        strategy, case, numbers = json.loads(line)
        results.setdefault(strategy, {})[case] = Found(**numbers)
    found: dict[str, Case] = {}
    for case in cases(whole):
        found[case.name] = case
        for name, strategy in strategies().items():
            if case.name not in results[name]:
                results[name][case.name] = strategy(case)
                _remember(kept, name, case, results[name][case.name])
    return results, found


def _remember(kept: Path | None, strategy: str, case: Case, found: Found) -> None:
    print(f"{case.name} ({case.counted}), {strategy}: {found}", file=sys.stderr, flush=True)
    if kept:
        with kept.open("a") as file:
            file.write(json.dumps([strategy, case.name, asdict(found)]) + "\n")


def tables(results: Results, found: dict[str, Case]) -> str:
    """Per sequence the worst over its data sets, per graph each share of wrong loops."""
    lines = []
    for sequence in ("00", "05", "07"):
        these = {name: case for name, case in found.items() if name.startswith(f"KITTI {sequence}")}
        if these:
            lines += _sequence(f"KITTI {sequence}", these, results)
    for graph in GRAPHS:
        these = {name: case for name, case in found.items() if name.startswith(f"{graph}, ")}
        if these:
            lines += _graph(graph, these, results)
    return "\n".join(lines)


def _sequence(title: str, these: dict[str, Case], results: Results) -> list[str]:
    some = next(iter(these.values()))
    lines = [
        f"**{title}**, worst of {len(these)} data sets (ATE: odometry {some.ate_odometry:.2f} m, exactly the true loops "
        f"{min(case.ate_clean for case in these.values()):.2f} to {max(case.ate_clean for case in these.values()):.2f} m)",
        "",
        "| strategy | precision | recall | wrong at the end | at any moment | at arrival | slowest, keyframes | ATE, m | CPU, s | verdict p50 / p99, ms |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for strategy, by_case in results.items():
        runs = [by_case[name] for name in these if name in by_case]
        if runs:
            lines.append(
                f"| {strategy} | {min(r.precision for r in runs):.1%} | {min(r.recall for r in runs):.1%} | {max(r.wrong for r in runs)} | "
                f"{_number(max(r.ever for r in runs), '.0f')} | {_number(min(r.prompt for r in runs), '.0%')} | "
                f"{_number(max(r.slowest for r in runs), '.0f')} | {max(r.ate for r in runs):.2f} | "
                f"{np.mean([r.seconds for r in runs]):.1f} | {_latency(runs)} |"
            )
    return [*lines, ""]


def _graph(title: str, these: dict[str, Case], results: Results) -> list[str]:
    shares = [name.partition(", ")[2] for name in these]
    some = next(iter(these.values()))
    lines = [
        f"**{title}**, {some.true.sum()} loops of its own; ATE to its optimum in m, wrong loops kept, recall, CPU in s (odometry: {some.ate_odometry:.2f} m)",
        "",
        "| strategy | " + " | ".join(shares) + " | verdict p50 / p99, ms |",
        "|---" * (len(shares) + 2) + "|",
    ]
    for strategy, by_case in results.items():
        runs = [by_case[name] for name in these if name in by_case]
        if len(runs) == len(these):
            cells = [f"{r.ate:.3f} m, {r.wrong} wrong, {r.recall:.1%}, {r.seconds:.1f} s" for r in runs]
            lines.append(f"| {strategy} | " + " | ".join(cells) + f" | {_latency(runs)} |")
    return [*lines, ""]


def _number(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)


def _latency(runs: Iterable[Found]) -> str:
    p50, p99 = (max(getattr(run, name) for run in runs) for name in ("p50", "p99"))
    return "" if np.isnan(p50) else f"{p50:.1f} / {p99:.1f}"


def write(text: str) -> None:
    """Between the two marks of the page."""
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def main() -> None:
    parser = ArgumentParser(description="Every strategy, into docs/robust.md.")
    parser.add_argument("--all", action="store_true", help="all data sets, masks and shares: hours")
    parser.add_argument("--keep", type=Path, help="a file that remembers what has been measured")
    given = parser.parse_args()
    strategies_table = tables(*measure(given.all, given.keep))
    promised = markdown(TITLE, EXPLANATION, rows(given.all)).partition("\n")[2]
    write(f"{promised}\n{strategies_table}")


if __name__ == "__main__":
    main()
