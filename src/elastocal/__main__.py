"""The `elastocal` command, and python -m elastocal."""

from __future__ import annotations

import gc
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer

# New containers between two searches for garbage in cycles.  Python's own 700 has every import and
# every fit walked through all that is loaded, 0.07 s each time, and finds nothing.
COLLECT_AFTER = 200_000


def commands() -> Typer:
    """The command line, with all commands: importing one registers it."""
    from elastocal.cli import measuring, using  # noqa: F401
    from elastocal.cli.app import app

    return app


def main() -> None:
    """Load the command line and run it; Ctrl-C ends it with one line, whenever it comes."""
    try:
        import logging

        from elastocal.screen import end_at_once, noting_interrupts, spelling

        gc.set_threshold(COLLECT_AFTER)
        # Where it keeps its list of fonts, and that there is no place for it, concerns nobody here.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        with noting_interrupts() as noted:
            try:
                with spelling():
                    # The same name however it is called: completion scripts are made of it.
                    commands()(prog_name="elastocal")
            except Exception:
                # A library that is being loaded may turn an interrupt into an error of its own.
                if noted:
                    raise KeyboardInterrupt from None
                raise
            finally:
                # Python ends by looking for garbage once more, which takes 0.17 s, as long as
                # fitting a small table does.
                gc.freeze()
                end_at_once()
    except KeyboardInterrupt:
        sys.stderr.write("elastocal: interrupted\n")
        sys.exit(130)  # 128 + SIGINT, as shells count


if __name__ == "__main__":
    main()
