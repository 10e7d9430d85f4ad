"""The command line: ``palpate`` or ``python -m palpate``."""

import signal
import sys


def main() -> int:
    from ._palpate import command_line

    # The command line has its own answer to Ctrl-C, which Python's would keep from it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return command_line(["palpate", *sys.argv[1:]], [sys.executable, "-m", "palpate"])


if __name__ == "__main__":
    sys.exit(main())
