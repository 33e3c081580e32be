"""The command line: elastocal VERB CELL [DATA] [options]."""

import os

# Many small matrices: a second thread of the linear algebra library only waits for the first.
# It must be said before numpy is loaded, and the user's own setting wins.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Importing a command registers it.
from elastocal.cli import (  # noqa: F401
    compensate,
    demo,
    design,
    diagnose,
    export,
    identify,
    import_,
    simulate,
    study,
)
from elastocal.cli.app import app


def main() -> None:
    """Entry point of the `elastocal` command."""
    # The same name however it is called: completion scripts are made of it.
    app(prog_name="elastocal")
