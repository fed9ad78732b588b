"""What is usual among accepted loops, so that noise which is stated ten times too large does not hold the gate open."""

from bisect import insort

from .chi2 import chi2_quantile

SHARE = 0.9  # quantile by which statistics are compared with those of chi-square
FEWEST, MOST = 20, 200  # accepted loops that say what is usual
ROOM = 3.0  # times the usual variance: tails are heavier than a Gaussian's
LEAST = 1e-3  # of the stated variance


class Usual:
    """How large the statistics of accepted loops are: noise that is stated ten times too large should not open the gate.

    The limit is what chi-square's quantile would be if the newest of them were typical, with room for heavy tails.
    """

    def __init__(self, dof: int) -> None:
        self._newest: list[float] = []  # in order of arrival
        self._sorted: list[float] = []
        self._usual = chi2_quantile(SHARE, dof)

    def add(self, statistic: float) -> None:
        self._newest.append(statistic)
        insort(self._sorted, statistic)
        if len(self._newest) > MOST:
            self._sorted.remove(self._newest.pop(0))

    def factor(self) -> float:
        """Of the variances, at most one."""
        if len(self._sorted) < FEWEST:
            return 1.0
        seen = self._sorted[int(SHARE * len(self._sorted))]
        return min(1.0, max(ROOM * seen / self._usual, LEAST))
