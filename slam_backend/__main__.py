"""`slam-backend`, and `python -m slam_backend`."""

import signal


def main() -> int:
    """Run the command line of the process. Ctrl-C before there is anything to explain it ends the process without a word."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else it is ignored, as in the background of a script
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from slam_backend.cli import main as command_line

    signal.signal(signal.SIGINT, before)
    return command_line()


if __name__ == "__main__":
    raise SystemExit(main())
