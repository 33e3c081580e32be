"""Diagnoses one visible folder after another; knows nothing else of the study.

Every line of stdin is {"folder": …, "arguments": […]}: `elastocal` with these arguments (a command,
its files and options), in that folder.  Every line of stdout is {"exit": …, "seconds": …,
"message": …}, with the last of what the command wrote to stderr.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import time
import traceback

from elastocal.cli.main import app

MESSAGE = 2000  # characters


def run(folder: str, arguments: list[str]) -> dict[str, object]:
    """Exit code, wall-clock seconds and message of one run."""
    os.chdir(folder)
    out, err, start = io.StringIO(), io.StringIO(), time.perf_counter()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            app([*arguments, "--quiet"])
            code: object = 0
        except SystemExit as end:
            code = end.code or 0
        except Exception:
            code = 70
            traceback.print_exc(file=err)
    seconds = time.perf_counter() - start
    return {"exit": code, "seconds": seconds, "message": err.getvalue()[-MESSAGE:]}


if __name__ == "__main__":
    # Whatever else is printed, by native libraries too, goes nowhere.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(run(asked["folder"], asked["arguments"])), file=answers, flush=True)
