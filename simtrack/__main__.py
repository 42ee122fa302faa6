"""``python -m simtrack``."""

import sys

from simtrack.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
