"""The work cell: everything known about arm, tool, tracker and model before measuring."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from datetime import date
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from elastocal.cell.arm_description import ModelSpec, Robot, Tool, Tracker, Unsteadiness
from elastocal.cell.file_keys import (
    TUPLE,
    File,
    Many,
    Spot,
    from_table,
    joint_values,
    keyed,
    record,
    table_of,
)
from elastocal.cell.plan_wishes import DesignSpec
from elastocal.cell.workspace_rules import Workspace
from elastocal.config import (
    NonNegative,
    Positive,
    Table,
    Text,
    Vector2,
    checked,
    header,
    key,
    read_toml,
)
from elastocal.errors import require
from elastocal.files import check_exists
from elastocal.plugin_loader import is_plugin_file
from elastocal.text import did_you_mean, listed, quoted

KnownEffects = Collection[str]


class PluginsTable(Table):
    """Effects, criteria and noise models of the user's own."""

    modules: list[Text] | None = key(
        'a list of Python files or modules, as in ["my_effects.py", "my_package.effects"]'
    )


def _modules(table: PluginsTable, spot: Spot, name: str) -> tuple[str, ...]:
    """Files as paths that exist, modules as they are named."""
    modules = table.modules or ()
    for i, module in enumerate(modules):
        if is_plugin_file(module):
            check_exists(spot.path.parent / module, f"plugins.modules[{i}]", spot.path)
    return tuple(str(spot.path.parent / m) if is_plugin_file(m) else m for m in modules)


@record
class Acceptance:
    """What a calibration must keep to be accepted: 3-D rms errors in m, None for any.

    `heldout`: in poses left out of the fit, the noise of a reading included; `new_poses`: the
    upper end of the 95 % interval of the arm's own error where it will be used; `test`: on
    readings that took no part in the fit.
    """

    heldout: Positive | None = keyed("a positive number in µm", "heldout_um", default=None)
    new_poses: Positive | None = keyed("a positive number in µm", "new_poses_um", default=None)
    test: Positive | None = keyed("a positive number in µm", "test_um", default=None)


ENTRY = partial(keyed, "a text", form=Text, default=None)


def _is_a_day(text: str) -> bool:
    try:
        date.fromisoformat(text)
    except ValueError:
        return False
    return True


@record
class CertificateEntries:
    """What a calibration certificate states besides the results (ISO/IEC 17025, 7.8.2).

    `country` by two letters (ISO 3166).  `temperature` in °C.  `instrument_uncertainty` m: expanded
    (k = 2), of a length, as the instrument's own certificate `instrument_calibration` has it.
    `limit` m: the largest position error with which the arm conforms; None for no such statement.
    """

    number: str | None = ENTRY()
    laboratory: str | None = ENTRY()
    country: str | None = ENTRY()
    customer: str | None = ENTRY()
    robot_serial: str | None = ENTRY()
    tool_serial: str | None = ENTRY()
    instrument: str | None = ENTRY()
    instrument_calibration: str | None = ENTRY()
    place: str | None = ENTRY()
    measured_on: str | None = ENTRY()
    operator: str | None = ENTRY()
    procedure: str | None = ENTRY()
    temperature: float | None = keyed("a number in °C", "temperature_c", default=None)
    instrument_uncertainty: NonNegative | None = keyed(
        "a number >= 0 in µm", "instrument_uncertainty_um", default=None
    )
    limit: Positive | None = keyed("a positive number in µm", "limit_um", default=None)

    def __post_init__(self) -> None:
        require(
            self.country is None or bool(re.fullmatch("[A-Z]{2}", self.country)),
            f"key certificate.country is {quoted(self.country)}, which takes the two letters of "
            'ISO 3166, as in "DE"',
        )
        day = self.measured_on or "2000-01-01"
        require(
            bool(re.fullmatch(r"\d{4}-\d\d-\d\d", day)) and _is_a_day(day),
            f"key certificate.measured_on is {quoted(day)}, which takes the date of measurement, "
            'as in "2026-03-17"',
        )

    @property
    def missing(self) -> list[str]:
        """The keys without which a document is no certificate."""
        needed = (name for name in vars(self) if name != "limit")
        keys = {
            "temperature": "temperature_c",
            "instrument_uncertainty": "instrument_uncertainty_um",
        }
        return [keys.get(name, name) for name in needed if getattr(self, name) is None]


@record
class Cell:
    """Everything known about arm, tool, tracker and model before measuring.

    `limits` joint → (lower, upper) in rad or m, which narrow those of the robot.  `plugins`:
    Python files, as absolute paths or relative to the working folder, and importable modules;
    `Model` runs them where it is told to.
    `path`: the file that it was read from.

    Examples:
        >>> from elastocal.cell.arm_description import ModelSpec
        >>> cell = ec.Cell(
        ...     name="our arm",
        ...     robot=ec.Robot.from_urdf("kr270_2.urdf", flange="flange"),
        ...     tool=ec.Tool(markers={"M1": [0.25, 0.0, 0.05]}),
        ...     model=ModelSpec(effects=["base_frame", "joint_compliance:joint2"]),
        ... )
        >>> ec.Model(cell).names[-1]
        'joint2.compliance'
    """

    name: str = keyed("a text", form=Text)
    path: File | None = None
    robot: Robot = keyed(
        'a table with urdf = "arm.urdf", mjcf = "arm.xml" or dh = "dh.csv"',
        required=True,
        default_factory=Robot,
    )
    tool: Tool = keyed("a table", default_factory=Tool)
    tracker: Tracker = keyed("a table", default_factory=Tracker)
    model: ModelSpec = keyed("a table", default_factory=ModelSpec)
    limits: dict[str, Annotated[tuple[float, float], TUPLE]] = keyed(
        "two numbers per joint, as in joint1_deg = [-170.0, 170.0]",
        form=dict[str, Vector2],
        into=joint_values,
        default_factory=dict,
    )
    workspace: Workspace = keyed("a table", default_factory=Workspace)
    design: DesignSpec = keyed("a table", default_factory=DesignSpec)
    require: Acceptance = keyed("a table", default_factory=Acceptance)
    certificate: CertificateEntries = keyed("a table", default_factory=CertificateEntries)
    plugins: Many[Text] = keyed("a table", form=PluginsTable, into=_modules, default=())
    noise: Unsteadiness = keyed("a table", default_factory=Unsteadiness)

    def __post_init__(self) -> None:
        for joint, (low, high) in self.limits.items():
            require(
                low < high,
                f"the limits of {joint} in [limits] take [lower, upper] with lower < upper; swap "
                "or correct them",
            )

    @classmethod
    def read(cls, path: str | Path, known_effects: KnownEffects | None = None) -> Cell:
        """Returns the cell that a TOML file describes, in SI units.

        Args:
            path: the cell file; paths in it are relative to it, and its files must exist.
            known_effects: as of `check`.

        Returns:
            The `Cell`; `Model` takes it as it takes the file.

        Raises:
            InputError: names file, key, what the key takes and the nearest valid name.

        Examples:
            >>> cell = ec.read_cell("cell.toml")
            >>> cell.model.observe, tuple(cell.tool.markers)
            ('deflection', ('M1', 'M2', 'M3'))
        """
        path = Path(path)
        table: Any = checked(table_of(cls), read_toml(path, "cell file"), path)
        cell = from_table(cls, table, Spot(path), path=path, name=table.name or path.stem)
        cell.check(known_effects)
        return cell

    def check(self, known_effects: KnownEffects | None = None) -> None:
        """Checks that the parts of the cell fit together, which `replace` may leave otherwise.

        Args:
            known_effects: the names that `model.effects` may use; None leaves them unchecked.

        Raises:
            InputError: an effect or a marker is unknown, or shapes of a URDF are asked for that
                there is none of.
        """
        where, sight = self.path or self.name, self.workspace.visibility
        self._check_markers(("workspace", "visibility", "normals"), sight.normals if sight else ())
        least = None if sight is None else sight.min_markers
        require(
            least is None or least <= len(self.tool.markers),
            f"{where}: key workspace.visibility.min_markers is {least}, but [tool.markers_m] has "
            f"{listed(self.tool.markers) or 'none'}; ask for fewer",
        )
        self._check_markers(("design", "marker_sigma_um"), self.design.marker_sigma)
        freedom = self.design.choose
        self._check_markers(("design", "choose", "markers_m"), freedom.markers if freedom else ())
        require(
            not self.workspace.urdf_geometry or self.robot.urdf is not None,
            f'{where}: key workspace.geometry = "urdf" needs [robot] urdf; give link_radius_mm '
            "for capsules along the links instead",
        )
        known = None if known_effects is None else tuple(known_effects)
        for i, choice in enumerate(self.model.effects):
            require(
                known is None or choice.name in known,
                f"{where}: key model.effects[{i}] names the unknown effect {quoted(choice.name)}"
                f"{did_you_mean(choice.name, known or ())}; known effects: {listed(known or ())}",
            )

    def _check_markers(self, table: tuple[str, ...], names: Iterable[str]) -> None:
        markers = tuple(self.tool.markers)
        for name in names:
            require(
                name in markers,
                f"{self.path or self.name}: {header(table)} names {quoted(name)}, which is no "
                f"marker of the cell{did_you_mean(name, markers)}; [tool.markers_m] has "
                f"{listed(markers) or 'none'}",
            )


read_cell = Cell.read
