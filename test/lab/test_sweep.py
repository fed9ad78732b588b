"""Grids of settings, and work in processes of their own."""

import os

import pytest

from slam_backend.core.errors import BadConfig
from slam_backend.lab.sweep import grid, in_processes


def test_a_grid_has_every_combination_the_last_key_changing_fastest():
    assert grid(["a.b=1, 2", "c=x,y"]) == [
        ("a.b=1", "c=x"),
        ("a.b=1", "c=y"),
        ("a.b=2", "c=x"),
        ("a.b=2", "c=y"),
    ]


@pytest.mark.parametrize(
    ("sweeps", "why"),
    [
        (["a"], "write name=value,value"),
        (["a="], "write name=value,value"),
        (["a=1,,2"], "write name=value,value"),
        (["a=1,1"], "names a value twice"),
        (["a=../b,c"], "none may hold a slash"),
        (["a=1,2", "a=3"], "is given twice"),
        ([f"{name}=1,2,3,4,5,6,7,8,9,10" for name in "abcd"], "10000 combinations"),
    ],
)
def test_what_is_no_grid_is_named(sweeps, why):
    with pytest.raises(BadConfig, match=why):
        grid(sweeps)


def test_answers_keep_the_order_of_the_jobs_and_each_end_is_told():
    ended = []
    assert in_processes(str.upper, ["a", "b", "c"], lambda: ended.append(1)) == ["A", "B", "C"]
    assert len(ended) == 3


def test_work_is_done_in_another_process_and_one_that_dies_does_not_hang_the_rest():
    (there,) = in_processes(os.path.realpath, ["/proc/self"], lambda: None)
    assert there.rpartition("/")[2] not in ("", str(os.getpid()))
    (answer,) = in_processes(os._exit, [9], lambda: None)
    assert "its process died" in answer
