"""All benchmarks, one process each; writes result.md beside this file, and the figure.

    python benchmarks/run.py [--full | --tiny] [--only PART …] [--again]

Parts: evaluation, scaling, startup, diagnosis, fits (whole fits beside their peers).  What a part
measured is kept in benchmarks/parts/; a part that was measured at this commit and size is not
measured again unless --again says so, so that an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from bench_part import HERE, ONE_THREAD, Part, commit, machine, markdown, ran, read_part

PARTS = ("evaluation", "scaling", "startup", "diagnosis")
FITS = "fits"  # prints its own Markdown
KEPT = HERE / "parts"
RESULT = HERE / "result.md"
DOCS = HERE.parent / "docs"
PAGE, FIGURE = DOCS / "performance.md", DOCS / "images" / "performance.png"
BEGIN, END = "<!-- numbers: written by benchmarks/run.py -->", "<!-- end of numbers -->"
PEERS = "ELASTOCAL_PEERS_PYTHON"


def done_already(name: str, size: str) -> bool:
    path = KEPT / f"{name}.json"
    if not path.exists():
        return False
    where = read_part(path).where
    return where["commit"] == commit() and where["size"] == size and "+" not in where["commit"]


def run_part(name: str, size: str) -> bool:
    command = [sys.executable, str(HERE / f"{name}.py"), "--size", size]
    command += ["--json", str(KEPT / f"{name}.json")]
    return subprocess.run(command, env=os.environ | ONE_THREAD).returncode == 0


def run_fits(size: str) -> bool:
    """fits_peers.py, whose table is kept as it prints it."""
    script = HERE / "fits_peers.py"
    if not script.exists():
        print(f"fits: {script.name} is not here; skipped")
        return True
    command = [sys.executable, str(script), *(["--quick"] if size != "full" else [])]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True)
    print(done.stdout)
    if done.returncode:
        return False
    ran = f"{time.strftime('%Y-%m-%d %H:%M')}, commit {commit()}, {machine()}; load average "
    KEPT.joinpath("fits.md").write_text(f"{ran}{os.getloadavg()[0]:.1f} after.\n\n{done.stdout}")
    return True


def result() -> str:
    """Every part that has been measured, one after the other, the goals first."""
    parts = [read_part(p) for name in PARTS if (p := KEPT / f"{name}.json").exists()]
    lines = ["# Benchmarks: result", "", "Written by `make bench`; how: README.md.", ""]
    lines += [*goals(parts), "", *[markdown(part) for part in parts]]
    fits = KEPT / "fits.md"
    if fits.exists():
        lines += ["## Whole fits beside their peers", "", fits.read_text()]
    return "\n".join(lines).rstrip() + "\n"


def goals(parts: list[Part]) -> list[str]:
    """One table of all goals."""
    lines = ["| goal | measured | |", "|---|---|---|"]
    for part in parts:
        words = ["met" if g.met else "**not met**" for g in part.goals]
        lines += [f"| {g.what} | {g.found} | {w} |" for g, w in zip(part.goals, words, strict=True)]
    return lines


def page() -> None:
    """The table of goals and the figure in docs/performance.md, between its two marks."""
    text = PAGE.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        print(f"{PAGE.name} has lost its marks; left as it is")
        return
    parts = [read_part(p) for name in PARTS if (p := KEPT / f"{name}.json").exists()]
    lines = [BEGIN, "", *goals(parts), ""]
    lines += [f"{part.title}: {ran(part.where)}" for part in parts]
    if FIGURE.exists():
        lines += ["", f"![Time against rows and parameters](images/{FIGURE.name})"]
    new = PAGE.with_suffix(".tmp")
    new.write_text(before + "\n".join([*lines, "", END]) + after, encoding="utf-8")
    os.replace(new, PAGE)
    print(f"wrote the numbers of {PAGE}")


def figure(path: Path) -> None:
    """Time per row of every way to B, and of B and the fit against rows, parameters, joints."""
    names = ("evaluation", "scaling")
    if not all((KEPT / f"{name}.json").exists() for name in names):
        print("no figure: it needs evaluation and scaling")
        return
    evaluation, scaling = (read_part(KEPT / f"{name}.json") for name in names)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawn, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    styles = ["o-", "s-", "^-", "D--", "v--", "o-", "s-"]
    for k, (way, times) in enumerate(evaluation.curves["cpu"].items()):
        points = [(n, t) for n, t in zip(evaluation.curves["rows"], times, strict=True) if t]
        ours = way.startswith("elastocal")
        left.plot(*zip(*points, strict=True), styles[k % len(styles)], label=way, ms=4,
                  lw=2.2 if ours else 1.0, color=f"C{k}")  # fmt: skip
    left.set(title="B, 51 parameters, one thread", xlabel="rows", ylabel="CPU time per row, µs")
    for what, label in (("B", "B"), ("fit", "whole fit")):
        curves = scaling.curves
        middle.plot(curves["rows"], curves[what], "o-", label=label, ms=4)
        right.plot(curves["parameters"], curves[f"parameters {what}"], "o-", label=label, ms=4)
    middle.set(title="46 parameters", xlabel="rows", ylabel="CPU time, s")
    right.set(title=_rows_of(scaling), xlabel="parameters", ylabel="CPU time, s")
    for axes in (left, middle, right):
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    path.parent.mkdir(exist_ok=True)
    drawn.savefig(path, dpi=120)
    print(f"wrote {path}")


def _rows_of(scaling: Part) -> str:
    return next(t.title for t in scaling.tables if t.title.startswith("Parameters")).partition(
        ", ")[2]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="the largest sizes too")
    parser.add_argument("--tiny", action="store_true", help="only to see that all of it runs")
    parser.add_argument("--only", nargs="+", choices=(*PARTS, FITS), default=[*PARTS, FITS])
    parser.add_argument("--again", action="store_true", help="also what is measured already")
    chosen = parser.parse_args()
    size = "full" if chosen.full else "tiny" if chosen.tiny else "short"
    KEPT.mkdir(exist_ok=True)
    failed = []
    for name in chosen.only:
        if name != FITS and not chosen.again and done_already(name, size):
            print(f"{name}: measured at this commit already (--again measures it anew)")
            continue
        print(f"--- {name}, load {os.getloadavg()[0]:.1f}", flush=True)
        if name == FITS and PEERS not in os.environ:
            print(f"fits: skipped, {PEERS} does not name the peers' Python (README.md)")
        elif not (run_fits(size) if name == FITS else run_part(name, size)):
            failed.append(name)
    if size != "tiny":
        temporary = RESULT.with_suffix(".tmp")
        temporary.write_text(result())
        os.replace(temporary, RESULT)
        print(f"wrote {RESULT}")
        figure(FIGURE)
        page()
    parts = [read_part(p) for name in PARTS if (p := KEPT / f"{name}.json").exists()]
    missed = [g.what for part in parts for g in part.goals if not g.met]
    for what in missed:
        print(f"not met: {what}")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; their errors stand above")


if __name__ == "__main__":
    main()
