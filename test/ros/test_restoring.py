"""A session that is restored says how far it is, and when it is done."""

from slam_backend.ros.restoring import Restoring


def test_it_says_each_tenth_once_and_then_that_it_is_done() -> None:
    said: list[str] = []
    restoring = Restoring(1000, said.append)
    for applied in (0, 50, 120, 130, 500, 560, 980, 980, 1100, 1200):
        restoring.look(applied)
    assert [line.partition(" of")[0] for line in said[:-1]] == [
        "restoring: 12%",
        "restoring: 50%",
        "restoring: 98%",
    ]
    assert said[-1].startswith("restored: 1000 records in ")


def test_where_nothing_is_to_be_restored_nothing_is_said() -> None:
    said: list[str] = []
    Restoring(0, said.append).look(10)
    assert not said
