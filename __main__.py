"""Run the command line with ``python -m phasemark``."""

import sys

from phasemark.cli import main

if __name__ == "__main__":
    sys.exit(main())
