"""All benchmarks, one process each; writes result.md beside this file.

    python benchmarks/run.py [--full] [--only PART …] [--beside SRC]

Parts: evaluation, costs, fits (whole fits beside their peers).  What a part printed is kept in
benchmarks/parts/, so that parts may run one by one.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

from bench_tools import HERE, ONE_THREAD, PEERS, where

TITLES = {
    "evaluation": "B of a table: 51 parameters of a 6-axis arm",
    "costs": "What the commands cost",
    "fits": "Whole fits beside their peers",
}
KEPT = HERE / "parts"


def run_part(name: str, size: str, beside: Path | None) -> bool:
    """Keeps what the part prints; False where it fails."""
    if name == "fits" and PEERS not in os.environ:
        print(f"fits: skipped, {PEERS} does not name the peers' Python (README.md)")
        return True
    command = [sys.executable, str(HERE / f"{name}.py"), "--size", size]
    if name == "fits":
        command = [sys.executable, str(HERE / "fits_peers.py"), *["--quick"] * (size != "full")]
    elif name == "costs" and beside:
        command += ["--beside", str(beside)]
    ran = where()
    print(f"--- {name}, {ran}", flush=True)
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True)
    print(done.stdout)
    if done.returncode == 0:
        KEPT.joinpath(f"{name}.md").write_text(f"{ran}; {size} sizes.\n\n{done.stdout.strip()}\n")
    return done.returncode == 0


def goals(parts: dict[str, str]) -> list[str]:
    """One table of all goals but those beside peers."""
    lines = ["| goal | measured | |", "|---|---|---|"]
    told = "\n".join(text for name, text in parts.items() if name != "fits")
    for what, found, met in re.findall(r"^- (.*): (.*): (met|NOT MET)$", told, re.M):
        lines.append(f"| {what} | {found} | {met.replace('NOT MET', '**not met**')} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="the largest sizes too")
    parser.add_argument("--only", nargs="+", choices=tuple(TITLES), default=list(TITLES))
    parser.add_argument("--beside", type=Path, help="costs: the folder src of another checkout")
    asked = parser.parse_args()
    size = "full" if asked.full else "short"
    KEPT.mkdir(exist_ok=True)
    failed = [name for name in asked.only if not run_part(name, size, asked.beside)]
    parts = {n: p.read_text() for n in TITLES if (p := KEPT / f"{n}.md").exists()}
    lines = ["# Benchmarks: result", "", "Written by `make bench`; how: README.md.", ""]
    lines += goals(parts)
    lines += [f"\n## {TITLES[name]}\n\n{text.strip()}" for name, text in parts.items()]
    (HERE / "result.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for line in goals(parts):
        if "not met" in line:
            print(line)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; their errors stand above")


if __name__ == "__main__":
    main()
