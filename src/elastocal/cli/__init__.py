"""The command line: elastocal VERB CELL [DATA] [options]."""

from elastocal.cli import demo, identify, simulate  # noqa: F401  (registers the commands)
from elastocal.cli.app import app


def main() -> None:
    """Entry point of the `elastocal` command."""
    app()
