"""Wrong loops: every strategy on real and on injected ones, beside what one would write with gtsam alone.

python -m bench robust                        what is promised, on a subset; some minutes
python -m bench.robust [--all] [--keep F]     every strategy on a subset or on everything (hours), into docs/robust.md

With a file to keep what has been measured it can be broken off at any time; `--told` writes what there is without measuring.
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
from bench.strategies import Found, Strategy, configured, played, strategies
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
LONE = {"witness": {"lone": 0.5}}
GROUPS, SIZE = 45, 5  # of wrong loops that agree, in each of two drives
SHARES = (0.0, 0.1, 0.3, 0.5)
SUBSET: dict[str, Any] = {"alphas": ("0.15",), "seeds": (None, 1)}


class Measured:
    """What strategies did to cases, each measured once. kept: a file that remembers it, so that a run can be broken off."""

    def __init__(self, kept: Path | None = None, only: bool = False) -> None:
        """only: what the file has; all else is left out."""
        self._kept, self._only = kept, only
        self._found: dict[tuple[str, str], Found] = {}
        for line in kept.read_text().splitlines() if kept and kept.is_file() else ():
            strategy, case, numbers = json.loads(line)
            self._found[strategy, case] = Found(**numbers)

    def of(self, name: str, strategy: Strategy, these: Iterable[Case]) -> list[tuple[Case, Found]]:
        """Of a strategy on each of some cases."""
        for case in these:
            if (name, case.name) not in self._found and not self._only:
                self._found[name, case.name] = found = strategy(case)
                self._remember(name, case, found)
        return [(case, self._found[name, case.name]) for case in these if (name, case.name) in self._found]

    def _remember(self, strategy: str, case: Case, found: Found) -> None:
        print(f"{case.name} ({case.counted}), {strategy}: {found}", file=sys.stderr, flush=True)
        if self._kept:
            with self._kept.open("a") as file:
                file.write(json.dumps([strategy, case.name, asdict(found)]) + "\n")


def rows(whole: bool = False, measured: Measured | None = None) -> list[Row]:
    """What is promised. whole: on all data sets instead of some."""
    measured, some = measured or Measured(), {} if whole else SUBSET
    found: list[Row] = []
    for sequence in ("00", "05"):
        found += _promised(sequence, list(vo_loops((sequence,), **some)), measured)
    found += _alone(list(vo_loops(("07",), **some)), measured)
    for name, bound in (("intel", "<= 0.05"), ("M3500", "<= 0.2")):
        found += _random(name, bound, measured)
    return found + list(_aliasing())


def _promised(sequence: str, these: list[Case], measured: Measured) -> Iterator[Row]:
    runs = measured.of("default", configured({}), these)
    if not runs:
        return
    name = f"KITTI {sequence}, {len(runs)} data sets"
    yield from _kept(name, runs, 0.98)
    case, run = max(runs, key=lambda pair: pair[1].ate / pair[0].ate_clean)
    exactly = f"{case.ate_clean:.2f} m with exactly the true loops"
    yield Row(f"{name}: ATE", f"{run.ate:.2f} m", exactly, run.ate / case.ate_clean, "<= 1.05")
    prompt, slowest = min(r.prompt for _, r in runs), max(r.slowest for _, r in runs)
    yield Row(f"{name}: accepted at arrival", f"{prompt:.1%}", "", prompt, ">= 0.85")
    yield Row(f"{name}: slowest of the rest", f"{slowest:.0f} keyframes", "", slowest, f"<= {FRAMES}")
    first = [case for case, _ in runs[:1]]
    for (_, run), (_, alone) in zip(
        runs, measured.of("default, true loops alone", _undisturbed, first), strict=False
    ):
        yield Row(
            f"{name}: the same in a drive without wrong loops", f"{run.slowest:.0f} keyframes",
            f"{alone.slowest:.0f} keyframes", run.slowest - alone.slowest, f"<= {FRAMES}",
        )  # fmt: skip
    scale = Config().gate.odometry_scale
    for factor in (1 / 3, 3.0):
        scaled = f"odometry noise x {factor:.2g}"
        settings = {"gate": {"odometry_scale": factor * scale}}
        if runs := measured.of(f"default, {scaled}", configured(settings), these):
            yield from _kept(f"KITTI {sequence}, {len(runs)} data sets, {scaled}", runs, 0.95)


def _undisturbed(case: Case) -> Found:
    return configured({})(case.honest)


def _kept(name: str, runs: list[tuple[Case, Found]], recall: float) -> Iterator[Row]:
    ever = max(r.ever for _, r in runs)
    yield Row(f"{name}: wrong loops kept at any moment", f"{ever:.0f}", "", ever, "<= 0")
    least = min(r.recall for _, r in runs)
    yield Row(f"{name}: recall", f"{least:.1%}", "", least, f">= {recall}")


def _alone(these: list[Case], measured: Measured) -> Iterator[Row]:
    """One or two true loops in the whole drive: nothing speaks for them."""
    if runs := measured.of("default", configured({}), these):
        name = f"KITTI 07, {len(runs)} data sets"
        ever = max(r.ever for _, r in runs)
        yield Row(f"{name}: wrong loops kept at any moment", f"{ever:.0f}", "", ever, "<= 0")
        case, run = max(runs, key=lambda pair: pair[1].ate / pair[0].ate_odometry)
        yield _drift(f"{name}: ATE", run, case.ate_odometry, "of odometry alone")
        unseen = min(r.unseen for _, r in runs)
        yield Row(f"{name}: true loops whose verdict is no witness", f"{unseen:.0%}", "", unseen, ">= 1")
    if runs := measured.of("default, lone loops let in", configured(LONE), these):
        name = f"KITTI 07, {len(runs)} data sets, lone loops let in"
        yield from _kept(name, runs, 1.0)
        case, run = max(runs, key=lambda pair: pair[1].ate / pair[0].ate_clean)
        yield _drift(f"{name}: ATE", run, case.ate_clean, "with exactly the true loops")


def _drift(name: str, run: Found, bound: float, what: str) -> Row:
    return Row(name, f"{run.ate:.2f} m", f"{bound:.2f} m {what}", run.ate / bound, "<= 1.1")


def _random(name: str, bound: str, measured: Measured) -> Iterator[Row]:
    these = [case for share in (0.0, 0.3, 0.5) if (case := injected(name, share)) is not None]
    runs = measured.of("default", configured({}), these)
    if len(runs) < len(these) or not runs:
        return
    (_, clean), *others = runs
    for case, run in others:
        what = f"{case.name} ({case.counted})"
        yield Row(f"{what}: ATE", f"{run.ate:.4f} m", f"{clean.ate:.4f} m clean", run.ate, bound)
        yield Row(
            f"{case.name}: CPU", f"{run.seconds:.1f} s", f"{clean.seconds:.1f} s clean", run.seconds / clean.seconds, "<= 1.5"
        )  # fmt: skip
        if name == "M3500":
            yield Row(f"{case.name}: verdict, p50", f"{run.p50:.1f} ms", "", run.p50, "<= 20")
            yield Row(f"{case.name}: verdict, p99", f"{run.p99:.1f} ms", "", run.p99, "<= 80")


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


def tables(whole: bool, measured: Measured) -> str:
    """Every strategy on every case: per sequence the worst over its data sets, per graph each share of wrong loops."""
    these = list(cases(whole))
    runs = {name: measured.of(name, strategy, these) for name, strategy in strategies().items()}
    lines = []
    for title in ("KITTI 00", "KITTI 05", "KITTI 07", *GRAPHS):
        some = [case for case in these if case.name.startswith(f"{title}, ")]
        names = {case.name for case in some}
        found = {
            name: {case.name: run for case, run in pairs if case.name in names}
            for name, pairs in runs.items()
        }
        if any(found.values()):
            lines += _sequence(title, some, found) if title not in GRAPHS else _graph(title, some, found)
    return "\n".join(lines)


def _sequence(title: str, these: list[Case], found: dict[str, dict[str, Found]]) -> list[str]:
    clean = [case.ate_clean for case in these]
    lines = [
        f"**{title}**, worst over the data sets (ATE: odometry {these[0].ate_odometry:.2f} m, exactly the true loops "
        f"{min(clean):.2f} to {max(clean):.2f} m)",
        "",
        "| strategy | data sets | precision | recall | wrong at the end | at any moment | at arrival | slowest, keyframes | ATE, m | CPU, s | verdict p50 / p99, ms |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for strategy, by_case in found.items():
        if runs := list(by_case.values()):
            lines.append(
                f"| {strategy} | {len(runs)} | {min(r.precision for r in runs):.1%} | {min(r.recall for r in runs):.1%} | {max(r.wrong for r in runs)} | "
                f"{_number(max(r.ever for r in runs), '.0f')} | {_number(min(r.prompt for r in runs), '.0%')} | "
                f"{_number(max(r.slowest for r in runs), '.0f')} | {max(r.ate for r in runs):.2f} | "
                f"{np.mean([r.seconds for r in runs]):.1f} | {_latency(runs)} |"
            )
    return [*lines, ""]


def _graph(title: str, these: list[Case], found: dict[str, dict[str, Found]]) -> list[str]:
    shares = [case.name.partition(", ")[2] for case in these]
    lines = [
        f"**{title}**, {these[0].true.sum()} loops of its own; ATE to its optimum in m, wrong loops kept, recall, CPU in s (odometry: {these[0].ate_odometry:.2f} m)",
        "",
        "| strategy | " + " | ".join(shares) + " | verdict p50 / p99, ms |",
        "|---" * (len(shares) + 2) + "|",
    ]
    for strategy, by_case in found.items():
        if runs := list(by_case.values()):
            cells = [_cell(by_case.get(case.name)) for case in these]
            lines.append(f"| {strategy} | " + " | ".join(cells) + f" | {_latency(runs)} |")
    return [*lines, ""]


def _cell(run: Found | None) -> str:
    if run is None:
        return ""
    return f"{run.ate:.3f} m, {run.wrong} wrong, {run.recall:.1%}, {run.seconds:.1f} s"


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
    parser.add_argument("--told", action="store_true", help="only what that file has")
    given = parser.parse_args()
    measured = Measured(given.keep, given.told)
    promised = markdown(TITLE, EXPLANATION, rows(given.all, measured)).partition("\n")[2]
    write(f"{promised}\n{tables(given.all, measured)}")


if __name__ == "__main__":
    main()
