"""The files that `elastocal design` reads and writes: checked before the work, written after it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from elastocal.errors import InputError, require

if TYPE_CHECKING:
    from elastocal.cell import Array, Cell
    from elastocal.design.order.execution import Execution
    from elastocal.design.plan import Plan
    from elastocal.manipulator.chain import Chain

PROGRAMS = {".src": "KUKA KRL", ".script": "URScript"}
PICTURES = (".png", ".svg")


def check_suffixes(programs: tuple[Path, ...], picture: Path | None) -> None:
    """Refuse names that do not say which kind of file is wanted."""
    for path in programs:
        require(
            path.suffix.lower() in PROGRAMS,
            f"--program {path}: the suffix says the language, "
            + " or ".join(f"{suffix} for {name}" for suffix, name in PROGRAMS.items()),
        )
    require(
        picture is None or picture.suffix.lower() in PICTURES,
        f"--picture {picture}: name it {' or '.join(PICTURES)}",
    )


def check_programs(cell: Cell, programs: tuple[Path, ...]) -> None:
    """Can these robot programs be written for this arm?  Told before the work, not after it."""
    import numpy as np

    from elastocal.cell import Motion
    from elastocal.design.order.execution import Execution
    from elastocal.manipulator.choice import load_chain

    if programs:
        chain = load_chain(cell)
        nothing = Execution((), np.zeros((0, chain.n_joints)), 0.0, False, Motion(), 0.0, 0, 0)
        for path in programs:
            _program(path, nothing, chain)


def check_apart(written: Iterable[Path | None], read: Iterable[Path | None]) -> None:
    """Refuse to write over an input, or two outputs into one file; None where none was named."""
    inputs = {path.resolve() for path in read if path is not None}
    seen: set[Path] = set()
    for path in written:
        if path is None:
            continue
        require(
            path.resolve() not in inputs,
            f"{path} is read and would be written over; name another output",
        )
        require(
            path.resolve() not in seen, f"{path}: two outputs of the same name; name another one"
        )
        seen.add(path.resolve())


def files_of(cell: Cell) -> tuple[Path | None, ...]:
    """Files that the cell names and a plan depends on."""
    from elastocal.plugin_loader import is_plugin_file

    robot, path = cell.robot, cell.design.test_path
    meshes = [s.mesh for s in cell.workspace.obstacles]
    meshes += [body.solid.mesh for body in cell.workspace.bodies]
    plugins = [Path(name) for name in cell.plugins if is_plugin_file(name)]
    test_path = None if path is None else path.file
    return (robot.urdf, robot.dh, robot.masses, test_path, *meshes, *plugins)


def write_all(plan: Plan, output: Path, programs: tuple[Path, ...], picture: Path | None) -> None:
    """plan.csv, plan.json, robot programs and picture, each whole or not at all."""
    from elastocal.files import atomic_write_text
    from elastocal.saving import save_plan

    chain = plan.model.chain
    save_plan(plan, output, shlex.join(["elastocal", *sys.argv[1:]]))
    for path in programs:
        text = _program(path, plan.execution, chain, plan.configurations, plan.forces)
        atomic_write_text(path, text)
    if picture is not None:
        from elastocal.report.plan_picture import write_plan_picture

        write_plan_picture(
            picture, plan.model.cell, chain, plan.q,
            names=plan.configurations, group=plan.group, group_names=plan.group_names,
        )  # fmt: skip


def write_page(plan: Plan, path: Path, read: list[Path]) -> None:
    """The report of a plan; `read` are the files it depends on."""
    from elastocal.report.page import write_plan_report

    command = shlex.join(["elastocal", *sys.argv[1:]])
    write_plan_report(plan, path, command=command, inputs=list(dict.fromkeys(read)))


def _program(
    path: Path, execution: Execution, chain: Chain,
    configurations: tuple[str, ...] = (), forces: Array | None = None,
) -> str:  # fmt: skip
    """The robot program to write to `path`."""
    from elastocal.design.programs.krl import krl_program
    from elastocal.design.programs.urscript import urscript_program

    text = krl_program if path.suffix.lower() == ".src" else urscript_program
    try:
        return text(execution, chain, configurations, forces, name=path.stem)
    except InputError as error:
        raise InputError(f"--program {path}: {error}") from None
