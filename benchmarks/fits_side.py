"""One fit of fits_peers.py in a process and an environment of its own, timed.

    PYTHON benchmarks/fits_side.py fits_elastocal|fits_figaroh|fits_pybotics HOW FOLDER OUT.npz

OUT.npz: where the marker is `predicted` at the fresh poses (n, 3) in m, how many `parameters` were
fitted, and the seconds of each step: import, read, fit.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from bench_tools import Clock

if __name__ == "__main__":
    clock, (name, how, folder, out) = Clock(), sys.argv[1:]
    with clock.step("import"):
        side = import_module(name)
    import numpy as np

    predicted, parameters = side.fit(how, Path(folder), clock)
    np.savez(out, predicted=predicted, parameters=parameters, **clock.seconds)
