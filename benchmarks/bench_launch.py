"""Run a command and write its wall and CPU seconds, peak memory and exit code as JSON.

    python -S -E bench_launch.py FACTS COMMAND ...

Kept small, and importing nothing that is not needed: its own memory counts as the command's.
"""

import json
import os
import sys
import time

facts, *command = sys.argv[1:]
start = time.perf_counter()
child = os.posix_spawnp(command[0], command, os.environ)
_, status, usage = os.wait4(child, 0)
with open(facts, "w") as file:
    json.dump(
        {
            "wall": time.perf_counter() - start,
            "cpu": usage.ru_utime + usage.ru_stime,
            "peak_mb": usage.ru_maxrss * (1e-6 if sys.platform == "darwin" else 1e-3),
            "code": os.waitstatus_to_exitcode(status),
        },
        file,
    )
