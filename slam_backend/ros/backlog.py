"""Messages that wait while there is no session to take them, bounded in number and in bytes."""

from collections import Counter, deque
from collections.abc import Sequence

Heard = tuple[str, str, bytes]  # topic, type, CDR


class Backlog:
    """In order of arrival. Beyond the bounds the oldest message of the topic that holds the most is dropped, and counted; those of a
    protected topic only when nothing else is left.

    dropped: topic -> how many, until whoever tells it clears it.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._topics: dict[
            str, deque[tuple[int, Heard]]
        ] = {}  # none of them empty; with numbers in order of arrival
        self._counts: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self._count = self._size = 0
        self._first, self._next = -1, 0
        self.protected = ""
        self.dropped: Counter[str] = Counter()

    def __bool__(self) -> bool:
        return bool(self._topics)

    def append(self, heard: Heard) -> None:
        self._topics.setdefault(heard[0], deque()).append((self._next, heard))
        self._next += 1
        self._weigh(heard, 1)
        self._relieve()

    def put_back(self, heard: Sequence[Heard]) -> None:
        """Before all that waits, in their order."""
        for each in reversed(heard):
            self._topics.setdefault(each[0], deque()).appendleft((self._first, each))
            self._first -= 1
            self._weigh(each, 1)
        self._relieve()

    def popleft(self) -> Heard:
        return self._pop(min(self._topics, key=lambda topic: self._topics[topic][0][0]))

    def clear(self) -> list[Heard]:
        """Takes all that waited, and forgets what was dropped."""
        taken = []
        while self:
            taken.append(self.popleft())
        self.dropped.clear()
        return taken

    def _pop(self, topic: str) -> Heard:
        waiting = self._topics[topic]
        _, heard = waiting.popleft()
        if not waiting:
            del self._topics[topic]
        self._weigh(heard, -1)
        return heard

    def _weigh(self, heard: Heard, sign: int) -> None:
        topic, size = heard[0], sign * len(heard[2])
        self._counts[topic] += sign
        self._bytes[topic] += size
        self._count += sign
        self._size += size

    def _relieve(self) -> None:
        while self._count > self._most or self._size > self._most_bytes:
            topic = max(self._topics, key=self._burden)
            self._pop(topic)
            self.dropped[topic] += 1

    def _burden(self, topic: str) -> tuple[bool, float]:
        share = max(self._counts[topic] / self._most, self._bytes[topic] / self._most_bytes)
        return topic != self.protected, share
