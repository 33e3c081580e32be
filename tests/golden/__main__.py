"""`make golden` and `make golden-accept`."""

import sys

from golden.runner import main

sys.exit(main(sys.argv[1:]))
