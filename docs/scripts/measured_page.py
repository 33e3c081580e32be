"""docs/measured.md and docs/measured/*.md, made from what the studies wrote into their own folders.

    python docs/scripts/measured_page.py

Words stand here, figures in the files that studies and benchmarks write or print: a part names
its file, and where that is longer than the part, the heading whose tables it shows.
"""

# ruff: noqa: E501
from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured.md"
FOLDER = ROOT / "docs" / "measured"
STUDIES = "experiment_design"

HEAD = """\
# What was measured

Made by `docs/scripts/measured_page.py` from the result files of the studies. Each table stands under the command that
prints it, run from a checkout. The real arms are public data; `experiment_design/real_arms/README.md` says where to
get them.
"""

TESTED = """\
## Bounds that the tests check

Continuous integration checks these bounds at each change, `make test` most of them.

| what | bound | test |
|---|---|---|
| B against independent derivatives, every effect and observation | 1e-7 relative | `tests/model/test_derivatives.py` |
| equilibrium against MuJoCo, KR 270, 2.6 kN | 1 µm | `tests/model/test_equilibrium.py` |
| error at new poses against the Cramér–Rao bound, parameters selected from the data | 15 % | `tests/identification/test_identify.py` |
| relaxation and exchange against all plans of small pools | the best one | `tests/planning/test_bounds.py` |
| realised against predicted error of plans: deflections, positions, a configuration effect | 4 standard errors | `tests/planning/test_promise.py` |
| exported arms read back (URDF by pinocchio, MJCF at equilibrium under load by MuJoCo, DH tables) | 1 µm | `tests/export` |
| NIST reference regressions, certified digits: eleven linear sets by ordinary least squares as published | 9; 7 on Filip and Wampler4, 5 on Wampler5 | `tests/identification/test_reference_fits.py` |
| the same through the fit of an arm under estimated noise of one size | 9; 7 on Filip and Wampler4, 5 on Wampler5 | `tests/identification/test_reference_fits.py` |
| twelve nonlinear NIST sets through the fit of an arm, from both of NIST's starts | 5 | `tests/identification/test_reference_fits.py` |
"""


@dataclass(frozen=True)
class Part:
    """A heading, a sentence, the command, and where its tables stand: file, then heading."""

    title: str
    says: str
    command: str
    file: str
    under: str = ""
    tables: int = 0


PAGES: dict[str, tuple[Part, ...]] = {
    "Real arms": (
        Part(
            "Identified",
            "Error at test poses, mm. Published: UR5 0.155 (hybrid method), 2.57 uncalibrated; WAM 2.92.",
            "python experiment_design/real_arms/run.py",
            f"{STUDIES}/real_arms/result.md",
        ),
        Part(
            "Diagnosed",
            'Error in mm, with `--test` where a second run exists. "Earlier version": causes judged one by one; '
            '"as diagnosed": all causes judged together. Times were taken on a busy two-core machine.',
            "python experiment_design/real_arms/diagnose.py",
            f"{STUDIES}/real_arms/diagnosis.md",
            tables=1,
        ),
        Part(
            "Planned",
            "Error in mm at poses not fitted: poses that `design` chose among those measured, and twenty times as many "
            "at random.",
            "python experiment_design/real_arms/planned.py",
            f"{STUDIES}/real_arms/planned.md",
        ),
    ),
    "Intervals and noise": (
        Part(
            "Linear simulations on the KR 270, noise of the paper's Table 1 or a polar tracker",
            "",
            "elastocal study experiment_design/coverage",
            f"{STUDIES}/coverage/result.md",
        ),
        Part(
            "Whole arms: parameters and noise model selected anew in each measurement session",
            "",
            "elastocal study experiment_design/arm_coverage",
            f"{STUDIES}/arm_coverage/result.md",
        ),
        Part(
            "The paper's iterated weights: noise of Table 1",
            "",
            "python experiment_design/kr270_reproduction/reproduce.py",
            f"{STUDIES}/kr270_reproduction/result.md",
            "What it is worth: noise of Table 1",
        ),
        Part(
            'A verdict that says "trusted at X"',
            "Arms, sizes, plans and hidden effects are random "
            "([how](../../experiment_design/verdict/README.md)).",
            "elastocal study experiment_design/verdict",
            f"{STUDIES}/verdict/result.md",
        ),
    ),
    "Plans": (
        Part(
            "As the paper's Table 2, joint limits only",
            "",
            "python experiment_design/kr270_plan/study.py",
            f"{STUDIES}/kr270_plan/result.md",
            "KR 270-2, joint limits alone",
        ),
        Part(
            "The same in a work cell with obstacles, hanging load and tracker",
            "",
            "python experiment_design/kr270_plan/study.py",
            f"{STUDIES}/kr270_plan/result.md",
            "KR 270-2 in a work cell",
        ),
        Part(
            "CPU time of a quick plan when nine of ten moves are blocked",
            "",
            "time elastocal design experiment_design/kr270_plan/crowded.toml --effort quick -o plan.csv",
            f"{STUDIES}/kr270_plan/README.md",
            "CPU of a quick plan",
            tables=1,
        ),
        Part(
            "Feasible poses and free moves, checked in MuJoCo",
            "",
            "python experiment_design/feasibility_check/check.py",
            f"{STUDIES}/feasibility_check/result.md",
        ),
        Part(
            "Eight cells, beside plans whose poses are polished one by one",
            "",
            "python benchmarks/plans.py --beside ../earlier/src",
            "benchmarks/README.md",
            "Eight cells",
            tables=1,
        ),
        Part(
            "Growth with poses, candidates and parameters",
            "",
            'python benchmarks/plans.py --only "UR10, limits" --efforts quick --growth',
            "benchmarks/README.md",
            "Growth of a UR10's quick plan",
            tables=1,
        ),
        Part(
            "Compared with FIGAROH: UR10, its own pool and regressor",
            "",
            "python benchmarks/design_peers.py",
            "benchmarks/README.md",
            "UR10: 1000 poses",
            tables=2,
        ),
    ),
    "Diagnosis of simulated arms": (
        Part(
            "One withheld effect",
            "Arms simulated in MuJoCo ([how](../../experiment_design/blind_diagnosis/README.md)).",
            "elastocal study experiment_design/blind_diagnosis",
            f"{STUDIES}/blind_diagnosis/result.md",
            "Blind check",
            tables=1,
        ),
        Part(
            "Whole arms",
            "Gear lines, eccentricity, sag, compliance, the last move, scatter and drift act at every joint "
            "at once. The oracle knows structure and orders. All tables: "
            "`experiment_design/blind_diagnosis/result_whole.md`.",
            "python experiment_design/blind_diagnosis/whole_arms.py --seed 27 --worlds 6 --poses 60",
            f"{STUDIES}/blind_diagnosis/result_whole.md",
            "Thirty arms",
        ),
    ),
    "Speed": (
        Part("Goals", "", "make bench", "benchmarks/result.md", "Benchmarks: result", 1),
        Part(
            "Whole fits compared with other packages, UR10, 300 poses",
            "",
            "make bench",
            "benchmarks/result.md",
            "Truth mdh, 300 poses",
            tables=1,
        ),
        Part(
            "The commands",
            "",
            "make bench",
            "benchmarks/result.md",
            "The commands",
            tables=1,
        ),
    ),
    "Compensation and export": (
        Part(
            "Commands of `compensate` in MuJoCo",
            "",
            "python experiment_design/compensation/study.py",
            f"{STUDIES}/compensation/result.md",
        ),
    ),
}


def shown(part: Part) -> str:
    """What a part shows: a file or what stands under one of its headings, or its first tables."""
    text = (ROOT / part.file).read_text(encoding="utf-8")
    pieces = re.split(r"^(#+ .*)$", text, flags=re.M)
    found = [] if part.under else [pieces[0].strip()]
    for heading, body in zip(pieces[1::2], pieces[2::2], strict=True):
        words = heading.lstrip("# ")
        if not part.under and not heading.startswith("# "):
            found.append(f"*{words}*")
        if words.startswith(part.under):
            found.append(body.strip())
    blocks = "\n\n".join(b for b in found if b)
    if not part.tables:
        return blocks
    tables = [b for b in blocks.split("\n\n") if b.startswith("|")]
    return "\n\n".join(tables[: part.tables])


def name_of(title: str) -> str:
    """File name of a page."""
    return title.lower().replace(" ", "-") + ".md"


def pages() -> dict[Path, str]:
    """Every page: where it stands and what it says."""
    made = {}
    for title, inside in PAGES.items():
        parts = [f"# Measured: {title[0].lower()}{title[1:]}\n"]
        for part in inside:
            says = f"{part.says}\n\n" if part.says else ""
            parts.append(f"## {part.title}\n\n{says}    {part.command}\n\n{shown(part)}\n")
        made[FOLDER / name_of(title)] = "\n".join(parts)
    contents = [
        f"- [{title}](measured/{name_of(title)}): {'; '.join(p.title for p in inside)}"
        for title, inside in PAGES.items()
    ]
    made[PAGE] = "\n".join([HEAD, *contents, "", TESTED])
    return made


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
