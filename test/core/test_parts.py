"""Connected parts of the graph and the factors that fix them in space."""

from slam_backend.core.parts import Parts


def two_parts() -> Parts:
    parts = Parts()
    parts.begin(1, "gauge/a")
    parts.put(2, beside=1)
    parts.begin(5, "gauge/b")
    parts.put(6, beside=5)
    return parts


def test_a_variable_belongs_to_the_part_of_what_it_was_put_beside():
    parts = two_parts()
    assert [parts.of(key) for key in (1, 2, 5, 6, 9)] == [1, 1, 5, 5, None]
    assert list(parts.members(5)) == [5, 6]
    assert len(parts) == 2
    assert (parts.gauge(1), parts.gauge(5)) == ("gauge/a", "gauge/b")


def test_merged_parts_are_one_with_the_gauge_of_the_one_that_is_kept():
    parts = two_parts()
    parts.merge(1, 5)
    assert {parts.of(key) for key in (1, 2, 5, 6)} == {1}
    assert sorted(parts.members(1)) == [1, 2, 5, 6]
    assert (parts.gauge(1), parts.gauge(5)) == ("gauge/a", None)
    parts.put(7, beside=6)
    assert parts.of(7) == 1
    assert len(parts) == 1


def test_a_released_part_has_no_gauge_but_stays():
    parts = two_parts()
    parts.release(5)
    parts.release(5)
    assert parts.gauge(5) is None
    assert parts.of(6) == 5


def test_what_was_put_or_begun_last_can_be_taken_back():
    parts = two_parts()
    parts.drop(6)
    assert parts.of(6) is None
    assert list(parts.members(5)) == [5]
    parts.drop(5)
    assert len(parts) == 1
    assert parts.gauge(5) is None
    parts.begin(5, "gauge/c")
    assert parts.gauge(5) == "gauge/c"
