"""`python -m surgicai_vision` is the command line."""

import sys

from surgicai_vision.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
