"""Reads the cell file: TOML → checked tables → frozen dataclasses in SI units."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from elastocal.cell import (
    CartesianNoise,
    Cell,
    EffectChoice,
    ModelSpec,
    Nominal,
    PolarNoise,
    Robot,
    Tool,
    Tracker,
)
from elastocal.cell_complaint import complaint
from elastocal.cell_design_reader import read_design
from elastocal.cell_design_schema import DesignTable
from elastocal.cell_joints import joint_values
from elastocal.cell_schema import (
    CellTable,
    ModelTable,
    NominalTable,
    RobotTable,
    ToolTable,
    TrackerTable,
)
from elastocal.cell_values import rotation_from_rpy
from elastocal.cell_workspace_reader import read_workspace
from elastocal.cell_workspace_schema import WorkspaceTable
from elastocal.errors import InputError
from elastocal.files import check_exists, read_text
from elastocal.labels import is_label
from elastocal.nearest import did_you_mean, listed, quoted
from elastocal.units import to_si

MAX_BYTES = 5_000_000
POLAR_KEYS = ("range_um", "range_ppm", "transverse_um", "transverse_ppm")


def read_cell(path: str | Path, known_effects: tuple[str, ...] | None = None) -> Cell:
    """The cell that a TOML file describes, in SI units.

    Args:
        path: The cell file.  Paths in it are relative to it; the robot's files must exist.
        known_effects: The names that `[model] effects` may use; None leaves them unchecked.

    Returns:
        The `Cell`.

    Raises:
        InputError: The file is wrong; the message names file, key, what the key takes and the
            nearest valid name.

    Examples:
        >>> cell = ec.read_cell("cell.toml")
        >>> cell.model.observe, list(cell.tool.markers)
        ('deflection', ['M1', 'M2', 'M3'])
    """
    path = Path(path)
    data = _parse(path)
    try:
        table = CellTable.model_validate(data)
    except ValidationError as error:
        raise complaint(path, data, error) from None
    tool = _tool(path, table.tool or ToolTable())
    markers = tuple(tool.markers)
    workspace = read_workspace(path, table.workspace or WorkspaceTable(), markers)
    if workspace.urdf_geometry and table.robot.urdf is None:
        raise InputError(
            f'{path}: key workspace.geometry = "urdf" needs [robot] urdf; give link_radius_mm for '
            "capsules along the links instead"
        )
    return Cell(
        name=table.name or path.stem,
        path=path,
        robot=_robot(path, table.robot),
        tool=tool,
        tracker=_tracker(path, table.tracker or TrackerTable()),
        model=_model(path, table.model or ModelTable(), known_effects),
        limits=_limits(path, table.limits or {}),
        workspace=workspace,
        design=read_design(path, table.design or DesignTable(), markers),
    )


def _parse(path: Path) -> dict[str, Any]:
    text = read_text(path, "cell file", MAX_BYTES)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error)
        if "(at end of document)" in reason:
            lines = text.split("\n")
            place = f"(at line {len(lines)}, column {len(lines[-1]) + 1}, the end of the file)"
            reason = reason.replace("(at end of document)", place)
        raise InputError(f"{path}: not valid TOML: {reason}") from None


def _robot(path: Path, table: RobotTable) -> Robot:
    given = [key for key in ("urdf", "dh") if getattr(table, key) is not None]
    if len(given) != 1:
        found = "both are given" if given else "neither is given"
        raise InputError(f"{path}: [robot] takes exactly one of urdf and dh; {found}")
    other = {"urdf": ("dh_convention", "masses"), "dh": ("base", "flange")}[given[0]]
    for key in other:
        if getattr(table, key) is not None:
            raise InputError(f"{path}: key robot.{key} has no meaning beside {given[0]}; drop it")

    def file(key: str) -> Path | None:
        text = getattr(table, key)
        return None if text is None else check_exists(path.parent / text, f"robot.{key}", path)

    convention = table.dh_convention or "standard"
    return Robot(file("urdf"), table.base, table.flange, file("dh"), convention, file("masses"))


def _tool(path: Path, table: ToolTable) -> Tool:
    markers = table.markers_m or {}
    for name in markers:
        if not is_label(name):
            raise InputError(
                f"{path}: marker name {quoted(name)} in [tool.markers_m] cannot stand in a "
                "table; use a non-empty text on one line without blanks at its ends"
            )
    point = table.load_point_m or [0.0, 0.0, 0.0]
    return Tool(np.array(point), {name: np.array(p) for name, p in markers.items()})


def _tracker(path: Path, table: TrackerTable) -> Tracker:
    polar = [key for key in POLAR_KEYS if getattr(table, key) is not None]
    if polar and table.sigma_um is not None:
        raise InputError(
            f"{path}: keys tracker.sigma_um and tracker.{polar[0]} are two styles of noise; "
            f"keep sigma_um, or {', '.join(POLAR_KEYS)}"
        )
    noise: CartesianNoise | PolarNoise | None = None
    if table.sigma_um is not None:
        noise = CartesianNoise(to_si(np.broadcast_to(np.array(table.sigma_um), 3), "um"))
    elif polar:
        if table.range_um is None or table.transverse_um is None:
            missing = "range_um" if table.range_um is None else "transverse_um"
            raise InputError(
                f"{path}: key tracker.{missing} is missing; beside tracker.{polar[0]} it takes "
                "a positive number in µm"
            )
        noise = PolarNoise(
            range=to_si(table.range_um, "um"),
            range_per_m=to_si(table.range_ppm or 0.0, "ppm"),
            transverse=to_si(table.transverse_um, "um"),
            transverse_per_m=to_si(table.transverse_ppm or 0.0, "ppm"),
        )
    return Tracker(
        position=np.array(table.position_m or [0.0, 0.0, 0.0]),
        noise=noise,
        anchor=None if table.anchor_m is None else np.array(table.anchor_m),
        rotation_sigma=None if table.rotation_urad is None else to_si(table.rotation_urad, "urad"),
        distance_sigma=None if table.distance_um is None else to_si(table.distance_um, "um"),
    )


def _model(path: Path, table: ModelTable, known_effects: tuple[str, ...] | None) -> ModelSpec:
    levels = joint_values(path, ("model", "compliance_levels"), table.compliance_levels or {})
    for joint, values in levels.items():
        if len(set(values)) < len(values):
            raise InputError(
                f"{path}: [model.compliance_levels] repeats a level of {joint}; give each once"
            )
    return ModelSpec(
        observe=table.observe or "position",
        effects=_effects(path, table.effects or [], known_effects),
        torque=table.torque or "computed",
        link_gravity=bool(table.link_gravity),
        deflection_model=table.deflection_model or "equilibrium",
        compliance_levels=levels,
        gear_ripple_orders=tuple(table.gear_ripple_orders or ()),
        thermal_driver=table.thermal_driver or "time",
        play_side=table.play_side or "load",
        nominal=_nominal(table.nominal or NominalTable()),
    )


def _nominal(table: NominalTable) -> Nominal:
    compliance, spring = table.joint_compliance, table.gravity_compensator
    return Nominal(
        joint_compliance=None if compliance is None else tuple(compliance),
        base_position=None if table.base_position_m is None else np.array(table.base_position_m),
        base_rotation=None if table.base_rpy_deg is None else rotation_from_rpy(table.base_rpy_deg),
        gravity_compensator=None if spring is None else spring.model_dump(exclude_none=True),
        settings=table.settings or {},
    )


def _effects(
    path: Path, entries: Sequence[str], known: tuple[str, ...] | None
) -> tuple[EffectChoice, ...]:
    choices: list[EffectChoice] = []
    for i, entry in enumerate(entries):
        name, colon, where = entry.partition(":")
        key = f"key model.effects[{i}]"
        if not name or (colon and not where) or entry != entry.strip():
            raise InputError(
                f'{path}: {key} takes "effect" or "effect:where"; found {quoted(entry)}'
            )
        if known is not None and name not in known:
            raise InputError(
                f"{path}: {key} names the unknown effect {quoted(name)}"
                f"{did_you_mean(name, known)}; known effects: {listed(known)}"
            )
        choice = EffectChoice(name, where or None)
        if choice in choices:
            raise InputError(f"{path}: {key} repeats {quoted(entry)}; keep one")
        choices.append(choice)
    return tuple(choices)


def _limits(path: Path, table: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, float]]:
    limits: dict[str, tuple[float, float]] = {}
    for joint, (low, high) in joint_values(path, ("limits",), table).items():
        if not low < high:
            raise InputError(
                f"{path}: the limits of {joint} in [limits] take [lower, upper] with "
                "lower < upper; swap or correct them"
            )
        limits[joint] = (low, high)
    return limits
