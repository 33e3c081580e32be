"""All benchmarks, one process each; writes result.md beside this file.

    python benchmarks/run.py [--full] [--only PART …] [--beside SRC]

Parts: evaluation, costs, fits (whole fits beside their peers).  A part that does not run, or fails,
stays in result.md as it stands there.
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
RESULT = HERE / "result.md"


def run_part(name: str, size: str, beside: Path | None) -> str:
    """What the part prints; nothing where it fails."""
    if name == "fits" and PEERS not in os.environ:
        print(f"fits: skipped, {PEERS} does not name the peers' Python (README.md)")
        return known_parts().get(name, "")
    command = [sys.executable, str(HERE / f"{name}.py"), "--size", size]
    if name == "fits":
        command = [sys.executable, str(HERE / "fits_peers.py"), *["--quick"] * (size != "full")]
    elif name == "costs" and beside:
        command += ["--beside", str(beside)]
    ran = where()
    print(f"--- {name}, {ran}", flush=True)
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True)
    print(done.stdout)
    return "" if done.returncode else f"{ran}; {size} sizes.\n\n{done.stdout.strip()}"


def known_parts() -> dict[str, str]:
    """What result.md has of each part."""
    _, *sections = re.split(r"^## ", RESULT.read_text(encoding="utf-8"), flags=re.M)
    texts = dict(section.split("\n", 1) for section in sections)
    return {name: texts[title].strip() for name, title in TITLES.items() if title in texts}


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
    ran = {name: run_part(name, size, asked.beside) for name in asked.only}
    parts = known_parts() | {name: text for name, text in ran.items() if text}
    lines = ["# Benchmarks: result", "", "Written by `make bench`; how: README.md.", ""]
    lines += goals(parts)
    lines += [f"\n## {TITLES[name]}\n\n{text}" for name, text in parts.items()]
    RESULT.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for line in goals(parts):
        if "not met" in line:
            print(line)
    if failed := [name for name, text in ran.items() if not text]:
        sys.exit(f"failed: {', '.join(failed)}; their errors stand above")


if __name__ == "__main__":
    main()
