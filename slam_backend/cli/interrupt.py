"""Ctrl-C as a wish to stop: what has been done so far is kept."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from ..core.errors import SlamError

SAID = b"\ninterrupted: what has been read so far is being saved; Ctrl-C again leaves at once\n"


@contextmanager
def interruptible(stop: Callable[[], object]) -> Iterator[None]:
    """The first SIGINT in here calls `stop`, the second raises KeyboardInterrupt; so does work that then fails: it was not done.

    Where it is ignored, as in the background of a script, it stays so.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    stopped = False

    def heard(_number: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()
        with suppress(OSError):
            os.write(2, SAID)  # print may be in the midst of something else

    before = signal.signal(signal.SIGINT, heard)
    try:
        yield
    except SlamError:
        if stopped:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)
