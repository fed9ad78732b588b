"""Many runs at once: all combinations of some settings' values, each in a process of its own."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import product
from multiprocessing import get_context
from typing import TypeVar

from ..core.errors import BadConfig

Job = TypeVar("Job")
LARGEST = 1000  # runs


def grid(sweeps: Sequence[str]) -> list[tuple[str, ...]]:
    """`key=a,b` and `other=1,2,3` to the six combinations, the last key changing fastest. BadConfig for anything else."""
    axes: list[list[str]] = []
    for sweep in sweeps:
        name, equals, text = sweep.partition("=")
        values = [value.strip() for value in text.split(",")]
        if not name.strip() or not equals or not all(values):
            raise BadConfig(
                f"--sweep {sweep}: write name=value,value,..., for instance keyframes.distance=0.5,1,2"
            )
        if len(set(values)) < len(values):
            raise BadConfig(f"--sweep {sweep}: names a value twice")
        if "/" in sweep or "\\" in sweep:
            raise BadConfig(
                f"--sweep {sweep}: each run gets a directory named by its values: none may hold a slash"
            )
        axes.append([f"{name.strip()}={value}" for value in values])
    names = [axis[0].partition("=")[0] for axis in axes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise BadConfig(f"--sweep {twice[0]}: is given twice; write all its values after one =")
    points = list(product(*axes))
    if len(points) > LARGEST:
        raise BadConfig(f"--sweep: {len(points)} combinations; at most {LARGEST} runs")
    return points


def in_processes(work: Callable[[Job], str], jobs: Sequence[Job], done: Callable[[], None]) -> list[str]:
    """What each job answered, in their order; `done` is called as each ends. A process that dies says so for its job.

    spawn, not fork: numpy and gtsam may hold threads.
    """
    answers = [""] * len(jobs)
    count = min(len(jobs), os.cpu_count() or 1)
    left = enumerate(jobs)
    running: dict[Future[str], int] = {}
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        while True:
            while len(running) < count and (
                each := next(left, None)
            ):  # no queue, that would go on after Ctrl-C
                running[_submitted(pool, work, each[1])] = each[0]
            if not running:
                return answers
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                n = running.pop(future)
                try:
                    answers[n] = future.result()
                except BrokenProcessPool:
                    answers[n] = "its process died (out of memory?)"
                done()


def _submitted(pool: ProcessPoolExecutor, work: Callable[[Job], str], job: Job) -> "Future[str]":
    """Failed already where the pool is broken."""
    try:
        return pool.submit(work, job)
    except BrokenProcessPool as broken:
        failed: Future[str] = Future()
        failed.set_exception(broken)
        return failed
