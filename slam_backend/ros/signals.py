"""Ctrl-C and SIGTERM as wishes: noted, and met at the next beat."""

import signal


def wishes() -> list[int]:
    """The numbers of the signals that ask the process to end, as they come from now on. They do nothing else: not even in the
    midst of an import, where an extension module would take Ctrl-C for its own failure.
    """
    heard: list[int] = []
    for wish in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wish, lambda number, _: heard.append(number))
    return heard
