"""The largest clique of a graph that grows: exact against brute force, and honest where it is not."""

from itertools import combinations

import numpy as np
import pytest

from slam_backend.core.robust.clique import LargestClique


def grown(matrix, steps=10**6):
    clique = LargestClique(steps)
    for v in range(len(matrix)):
        clique.add(sum(1 << u for u in range(v) if matrix[u, v]))
    return clique


def random_graph(size, density, seed):
    upper = np.triu(np.random.default_rng(seed).random((size, size)) < density, 1)
    return upper | upper.T


def largest_by_force(matrix):
    size = len(matrix)
    return max(
        (members for n in range(size + 1) for members in combinations(range(size), n)
         if all(matrix[u, v] for u, v in combinations(members, 2))),
        key=len,
    )  # fmt: skip


@pytest.mark.parametrize("density", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("seed", range(4))
def test_it_is_as_large_as_the_one_found_by_trying_all(density, seed):
    matrix = random_graph(13, density, seed)
    clique = grown(matrix)
    assert clique.exact
    assert len(clique.members) == len(largest_by_force(matrix))
    assert all(matrix[u, v] for u, v in combinations(sorted(clique.members), 2))


def test_every_vertex_of_a_planted_clique_is_found_among_many_others():
    matrix = random_graph(300, 0.1, seed=1)
    planted = list(range(7, 300, 12))
    matrix[np.ix_(planted, planted)] = True
    np.fill_diagonal(matrix, val=False)
    assert grown(matrix).members == set(planted)


def test_what_is_the_largest_so_far_stays_until_something_larger_comes():
    clique = LargestClique(100)
    for beside in (0b0, 0b1, 0b0, 0b100):  # two pairs: the first one came first
        clique.add(beside)
    assert clique.members == {0, 1}
    clique.add(0b1100)
    assert clique.members == {2, 3, 4}


def test_beyond_its_bound_of_work_it_says_that_it_is_not_exact_and_still_is_a_clique():
    matrix = random_graph(60, 0.7, seed=3)
    clique = grown(matrix, steps=100)
    assert not clique.exact
    assert all(matrix[u, v] for u, v in combinations(sorted(clique.members), 2))
    assert len(clique.members) <= len(grown(matrix).members)
