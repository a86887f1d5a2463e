"""``python -m acquire``: the command line."""

import sys

from acquire.cli import main

if __name__ == "__main__":
    sys.exit(main())
