"""The `sci` command, as `sci` or `python -m sci`."""

import signal
import sys

from . import _sci


def main():
    # Python's own handler would wait for the interpreter, which never runs again; commands that end in order on Ctrl-C set theirs.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _sci.run_command(["sci", *sys.argv[1:]])


if __name__ == "__main__":
    main()
