"""Entry point: `python -m train fit`, which is `neuroprior fit`."""

import sys

from neuroprior.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
