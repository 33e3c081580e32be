"""Writing an identification's result: JSON, residual table, report."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from elastocal.files import atomic_write_text
from elastocal.identification.result import Calibration
from elastocal.saving import save_residuals
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.report.page import Published


def write_results(
    result: Calibration,
    output: Path | None,
    report: Path | None,
    residuals: Path | None,
    inputs: list[Path],
    truth: dict[str, float] | None = None,
    seed: int | None = None,
    published: Published | None = None,
) -> None:
    """Write what was asked for, each file whole or not at all.

    `inputs` are named with their hashes in the report, where `truth` and `published` (SI) stand
    beside the estimates.
    """
    if output is not None:
        atomic_write_text(output, json_text(result.to_json()) + "\n")
    if residuals is not None:
        save_residuals(result, residuals)
    if report is not None:
        from elastocal.report.page import write_identification_report

        command = shlex.join(["elastocal", *sys.argv[1:]])
        write_identification_report(
            result, report, truth=truth, command=command, inputs=inputs, seed=seed,
            published=published,
        )  # fmt: skip
