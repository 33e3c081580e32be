"""The `elastocal` command, and python -m elastocal."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer

INTERRUPTED = 130  # 128 + SIGINT, as shells count


def commands() -> Typer:
    """The command line, with all commands: importing one registers it."""
    from elastocal.cli import measuring, using  # noqa: F401
    from elastocal.cli.app import app

    return app


def main() -> None:
    """Load the command line and run it; Ctrl-C ends it with one line, whenever it comes."""
    try:
        from elastocal.screen import end_at_once, noting_interrupts

        with noting_interrupts() as noted:
            try:
                commands()
                from elastocal.cli.app import run_app

                run_app()
            except Exception:
                # A library that is being loaded may turn an interrupt into an error of its own.
                if noted:
                    raise KeyboardInterrupt from None
                raise
            finally:
                end_at_once()
    except KeyboardInterrupt:
        sys.stderr.write("elastocal: interrupted\n")
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
