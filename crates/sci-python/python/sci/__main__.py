"""The `sci` command, as `sci` or `python -m sci`."""

import sys

from . import _sci


def main():
    _sci.run_command(["sci", *sys.argv[1:]])


if __name__ == "__main__":
    main()
