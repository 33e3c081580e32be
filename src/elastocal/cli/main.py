"""The entry point: what must be said before numpy is loaded, and all commands."""

import gc
import logging
import os
from typing import Annotated

# Many small matrices: a second thread of the linear algebra library only waits for the first.
# It must be said before numpy is loaded, and the user's own setting wins.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# No plug-in of pydantic has to do with a cell file; looking for them reads what is installed.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

# Figures are drawn into files; what a window would take does not concern them.
os.environ["MPLBACKEND"] = "agg"

import typer

from elastocal import __version__

# Importing a command registers it.
from elastocal.cli import measuring, using  # noqa: F401
from elastocal.cli.app import app
from elastocal.screen import close_streams, complain, prepare_streams, say

# New containers between two searches for garbage in cycles.  Python's own 700 has every import and
# every fit walked through all that is loaded, 0.07 s each time, and finds nothing.
COLLECT_AFTER = 200_000


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"elastocal {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Version.")
    ] = False,
    backend: Annotated[
        str | None, typer.Option(help="What evaluates the model: auto or numpy; default: auto.")
    ] = None,
) -> None:
    """Calibrate industrial robot arms and explain what is left over."""
    from elastocal.model.evaluate import VARIABLE, checked, chosen_backend

    # By the environment, so that processes which a command starts choose the same.
    if backend is not None:
        os.environ[VARIABLE] = checked(backend.strip() or "auto", "--backend")
    chosen_backend()
    if os.environ.get("ELASTOCAL_CACHE"):
        complain("ELASTOCAL_CACHE is no longer read, as nothing is kept between runs; unset it")


def main() -> None:
    gc.set_threshold(COLLECT_AFTER)
    # Where it keeps its list of fonts, and that there is no place for it, concerns nobody here.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    prepare_streams()
    try:
        # The same name however it is called: completion scripts are made of it.
        app(prog_name="elastocal")
    finally:
        close_streams()
        # Python ends by looking for garbage once more, which takes 0.17 s, as long as fitting a
        # small table does.
        gc.freeze()
