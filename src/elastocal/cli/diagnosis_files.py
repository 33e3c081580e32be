"""The files that `elastocal diagnose` writes: JSON, report, extra poses, extended cell."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal.files import atomic_write_text
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.diagnosis.result import Diagnosis
    from elastocal.manipulator.model import Model


@dataclass(frozen=True)
class Outputs:
    """Where to write what; None is not asked for."""

    json: Path | None = None
    report: Path | None = None
    plan: Path | None = None
    cell: Path | None = None

    @property
    def wanted(self) -> list[Path]:
        return [p for p in (self.json, self.report, self.plan, self.cell) if p is not None]


def write_diagnosis(
    outputs: Outputs,
    diagnosis: Diagnosis,
    content: dict[str, Any],
    model: Model,
    cell: Path,
    data: Path,
    seed: int,
) -> list[str]:
    """Write what was asked for, each file whole or not at all; a sentence per file.

    `content` is the published diagnosis; `cell` and `data` were read for it.
    """
    told = []
    if outputs.json is not None:
        atomic_write_text(outputs.json, json_text(content) + "\n")
        told.append(f"wrote {outputs.json}")
    if outputs.report is not None:
        from elastocal.report.page import write_diagnosis_report

        command = shlex.join(["elastocal", *sys.argv[1:]])
        write_diagnosis_report(
            diagnosis, model, outputs.report, data=str(data), command=command,
            inputs=[cell, data], seed=seed,
        )  # fmt: skip
        told.append(f"wrote {outputs.report}")
    if outputs.plan is not None:
        told.append(_write_plan(outputs.plan, diagnosis, model.chain.kinds))
    if outputs.cell is not None:
        from elastocal.diagnosis.extended_cell import write_extended_cell

        write_extended_cell(cell, outputs.cell, diagnosis.effects, diagnosis.model_keys)
        added = ", ".join(f"{f.effect}:{f.where}" for f in diagnosis.effects)
        told.append(f"wrote {outputs.cell} with {added or 'no further effect'}")
        if added:
            again = shlex.join(["elastocal", "identify", str(outputs.cell), str(data)])
            told.append(f"to go on: {again} -o result.json")
    return told


def _write_plan(path: Path, diagnosis: Diagnosis, kinds: Sequence[str]) -> str:
    """Write the extra poses, and say so; or why there are none to write."""
    extra = diagnosis.extra
    if extra is None:
        return f"{path} not written: there are no rivals to tell apart"
    if extra.plan is None:
        return f"{path} not written: no pose tells the rivals apart"
    from elastocal.saving import save_extra_poses

    save_extra_poses(path, extra.plan, kinds)
    return f"wrote {path}: {extra.n_poses} poses, {len(extra.plan)} visits"
