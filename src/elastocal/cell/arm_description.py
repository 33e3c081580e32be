"""The arm, what it carries, what measures it, and the model of it (DESIGN: cell file)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from elastocal.config import (
    AnyFloat,
    File,
    Many,
    NonNegative,
    Numbers,
    Positive,
    Rotation,
    Spot,
    Table,
    Text,
    Vector3,
    checked,
    file_key,
    from_table,
    joint_values,
    key,
    keyed,
    keys_of,
    numbers,
    record,
    turn_key,
)
from elastocal.messages import InputError, is_label, listed, quoted, require
from elastocal.units import Array

Observe = Literal["position", "deflection", "pose", "distance"]
Convention = Literal["standard", "modified"]
Sigma = Annotated[Array, numbers(3, above=0, one_for_all=True)]
Scatter = Annotated[Array, numbers(least=0, one_for_all=True)]
Compliances = Annotated[Many[NonNegative], Field(min_length=1)]
ZEROS = partial(np.zeros, 3)
SOURCES = ("urdf", "mjcf", "dh")  # keys of [robot] that state the nominal arm
POLAR_KEYS = ("range_um", "range_ppm", "transverse_um", "transverse_ppm")


@record
class Robot:
    """A URDF or a MuJoCo model with the names of its first and last link, or a DH table.

    `masses`: the table of link masses of a DH robot.  `dh` takes a UR's factory calibration too: a
    YAML of ur_calibration, or a calibration.conf with `ur_model`.  `joint_names` says what jointN
    means where the file has such a name at another place.  Files as absolute or relative paths.

    Examples:
        >>> robot = ec.Robot.from_urdf("kr270_2.urdf", flange="flange")
        >>> ec.Model(ec.Cell(name="bare arm", robot=robot)).chain.n_joints
        6
    """

    urdf: File | None = file_key('the path of a URDF file, e.g. "arm.urdf"', default=None)
    mjcf: File | None = file_key('the path of a MuJoCo model, e.g. "arm.xml"', default=None)
    base: Text | None = keyed(
        "the name of a link of the URDF, or of a body of the MuJoCo model", default=None
    )
    flange: Text | None = keyed(
        "the name of a link of the URDF, or of a body or site of the MuJoCo model", default=None
    )
    dh: File | None = file_key('the path of a DH table, e.g. "nominal_dh.csv"', default=None)
    dh_convention: Convention = keyed(default="standard")
    masses: File | None = file_key(
        'the path of a table of link masses, e.g. "links.csv"', default=None
    )
    ur_model: Text | None = keyed('the name of a Universal Robot, e.g. "UR10e"', default=None)
    joint_names: Literal["order", "file"] | None = keyed(
        '"order" (jointN is the Nth joint) or "file" (names of the robot\'s file)', default=None
    )

    def __post_init__(self) -> None:
        given = [name for name in SOURCES if getattr(self, name) is not None]
        told = f"{listed(given)} are given"
        require(len(given) < 2, f"[robot] takes exactly one of {listed(SOURCES)}; {told}")

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        given = [name for name in SOURCES if name in table]
        told = f"[robot] takes exactly one of {listed(SOURCES)}; none is given"
        spot.require(given, told)
        of_a_table = ("dh_convention", "masses", "ur_model")
        other = {"urdf": of_a_table, "mjcf": of_a_table, "dh": ("base", "flange")}
        for name in other[given[0]] if len(given) == 1 else ():
            told = f"key robot.{name} has no meaning beside {given[0]}; drop it"
            spot.require(name not in table, told)
        return {}

    @classmethod
    def from_urdf(
        cls, path: str | Path, base: str | None = None, flange: str | None = None
    ) -> Robot:
        """Returns the arm of a URDF from link `base` to link `flange`.

        Args:
            path: the URDF file; its meshes are not needed.
            base: name of the first link; None takes the root.
            flange: name of the last link; None takes the last one.

        Raises:
            InputError: a value is of the wrong type.

        Examples:
            >>> ec.Robot.from_urdf("kr270_2.urdf", flange="flange").flange
            'flange'
        """
        return cls(urdf=Path(path), base=base, flange=flange)

    @classmethod
    def from_mjcf(
        cls, path: str | Path, base: str | None = None, flange: str | None = None
    ) -> Robot:
        """Returns the arm of a MuJoCo model from body `base` to body or site `flange`.

        Args:
            path: the MJCF file; its meshes are not needed where bodies state their inertia.
            base: name of the body in whose frame the chain starts; None takes the world.
            flange: name of a body or a site; None takes the body before the fingers branch off.

        Raises:
            InputError: a value is of the wrong type.

        Examples:
            >>> ec.Robot.from_mjcf("arm.xml", flange="attachment_site").flange
            'attachment_site'
        """
        return cls(mjcf=Path(path), base=base, flange=flange)

    @classmethod
    def from_dh(
        cls, path: str | Path, convention: Convention = "standard", masses: str | Path | None = None
    ) -> Robot:
        """Returns the arm of a table of Denavit-Hartenberg parameters.

        Args:
            path: the table, with columns theta0_rad, d_m or d_mm, a_m or a_mm, alpha_rad.
            convention: "standard", or "modified" (Craig's).
            masses: table of link masses in kg and centres of mass in m, for weights.

        Raises:
            InputError: a value is of the wrong type, or the convention is unknown.

        Examples:
            >>> ec.Robot.from_dh("dh.csv", convention="modified").dh_convention
            'modified'
        """
        links = None if masses is None else Path(masses)
        return cls(dh=Path(path), dh_convention=convention, masses=links)


@record
class Tool:
    """`load_point` (3,) and `markers` name → (3,), in m in the flange frame.

    Examples:
        >>> tool = ec.Tool(load_point=[0.2, 0.0, 0.25], markers={"M1": [0.25, 0.0, 0.05]})
        >>> tool.markers["M1"]
        array([0.25, 0.  , 0.05])
    """

    load_point: Vector3 = keyed(
        "three numbers in m, in the flange frame", "load_point_m", default_factory=ZEROS
    )
    markers: dict[str, Vector3] = keyed(
        "three numbers in m per marker, flange frame", "markers_m", default_factory=dict
    )

    def __post_init__(self) -> None:
        for name in self.markers:
            require(
                is_label(name),
                f"marker name {quoted(name)} in [tool.markers_m] cannot stand in a table; use a "
                "non-empty text on one line without blanks at its ends or what cannot be seen",
            )


@record
class CartesianNoise:
    """Standard deviations (3,) in m along x, y, z of the tracker frame; one number for all."""

    sigma: Sigma = keyed("one positive number in µm, or three for x, y, z", "sigma_um")


@record
class PolarNoise:
    """Range and transverse standard deviation: constant part in m, part per metre of range (1)."""

    range: Positive = keyed("a positive number in µm", "range_um")
    range_per_m: NonNegative = keyed("a number >= 0 in µm per m", "range_ppm")
    transverse: Positive = keyed("a positive number in µm", "transverse_um")
    transverse_per_m: NonNegative = keyed("a number >= 0 in µm per m", "transverse_ppm")


@record
class Tracker:
    """`position` (3,) m: where the instrument stands in the frame of the data.

    `anchor` (3,) m: nominal cable or ball-bar anchor for distances.
    `rotation_sigma` rad and `distance_sigma` m: noise of pose and distance readings, if known.

    Examples:
        >>> from elastocal.cell.arm_description import CartesianNoise
        >>> ec.Tracker(position=[3.0, 0.0, 1.5], noise=CartesianNoise(sigma=[1e-5] * 3)).noise.sigma
        array([1.e-05, 1.e-05, 1.e-05])
    """

    position: Vector3 = keyed("three numbers in m", "position_m", default_factory=ZEROS)
    noise: CartesianNoise | PolarNoise | None = keyed(
        keys=keys_of(CartesianNoise, PolarNoise), default=None
    )
    anchor: Vector3 | None = keyed("three numbers in m", "anchor_m", default=None)
    rotation_sigma: Positive | None = keyed(
        "a positive number in µrad", "rotation_urad", default=None
    )
    distance_sigma: Positive | None = keyed("a positive number in µm", "distance_um", default=None)

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        polar, cartesian = [name for name in POLAR_KEYS if name in table], "sigma_um" in table
        if not polar:
            return {"noise": from_table(CartesianNoise, table, spot) if cartesian else None}
        spot.require(
            not cartesian,
            f"keys tracker.sigma_um and tracker.{polar[0]} are two styles of noise; keep sigma_um, "
            f"or {', '.join(POLAR_KEYS)}",
        )
        for name in ("range_um", "transverse_um"):
            spot.require(
                name in table,
                f"key tracker.{name} is missing; beside tracker.{polar[0]} it takes a positive "
                "number in µm",
            )
        known = {"range_ppm": 0.0, "transverse_ppm": 0.0}
        return {"noise": from_table(PolarNoise, known | table, spot)}


@record
class Unsteadiness:
    """What differs from visit to visit, beside the noise of a reading, and the tails of that noise.

    `joints` (joints,) or (1,), in rad or m: by how much each joint settles elsewhere at each visit.
    `drift` m in each direction: of base or tracker, with the correlation exp(−|t − t′|/`lasting`)
    of times in s.  `configuration` m in each direction: a deviation that all readings of a
    configuration share, whatever the load.  `tails`: degrees of freedom of Student's t, of which
    the noise of a reading is drawn, its standard deviation the stated one; None: normal.
    """

    joints: Scatter = keyed(
        "a number >= 0 in µrad (µm where a joint slides), or one per joint", "joints_urad",
        default_factory=partial(np.zeros, 1),
    )  # fmt: skip
    drift: NonNegative = keyed("a number >= 0 in µm", "drift_um", default=0.0)
    lasting: Positive = keyed("a positive number in s", "lasting_s", default=3600.0)
    configuration: NonNegative = keyed("a number >= 0 in µm", "configuration_um", default=0.0)
    tails: Positive | None = keyed("a number > 2", default=None)

    def __post_init__(self) -> None:
        require(
            self.tails is None or self.tails > 2,
            f"key noise.tails is {self.tails}: Student's t with two degrees of freedom or fewer "
            "has no standard deviation, which is what [tracker] states; take a number > 2, as 3",
        )

    @property
    def shared(self) -> bool:
        return bool(self.joints.any() or self.drift or self.configuration)

    def of_joints(self, n: int) -> Array:
        """Standard deviations (n,) of n joints; InputError where there are others."""
        require(
            len(self.joints) in (1, n),
            f"key noise.joints_urad has {len(self.joints)} numbers, but the arm has {n} joints; "
            "give one number for all, or one per joint",
        )
        return np.broadcast_to(self.joints, (n,))


@record
class EffectChoice:
    """One entry of `effects`: "joint_compliance", or "joint_compliance:joint2" for one place."""

    name: str
    where: str | None = None

    @classmethod
    def parse(cls, entry: str) -> EffectChoice:
        """Returns the choice that "effect" or "effect:where" states; raises InputError for others.

        >>> EffectChoice.parse("joint_compliance:joint2")
        EffectChoice(name='joint_compliance', where='joint2')
        """
        name, colon, where = entry.partition(":")
        ok = name and (where or not colon) and entry == entry.strip()
        require(ok, f'takes "effect" or "effect:where"; found {quoted(entry)}')
        return cls(name, where or None)

    def __str__(self) -> str:
        return f"{self.name}:{self.where}" if self.where else self.name


def _choices(entries: object) -> object:
    if not isinstance(entries, list | tuple):
        return entries
    choices: list[object] = []
    for i, entry in enumerate(entries):
        try:
            choices.append(EffectChoice.parse(entry) if isinstance(entry, str) else entry)
        except InputError as error:
            raise InputError(f"key model.effects[{i}] {error}") from None
    return tuple(choices)


class CompensatorTable(Table):
    """A spring between two anchor points that takes a part of a joint's load."""

    joint: Text = key('the joint the spring spans, e.g. "joint2"', ...)
    stiffness_N_per_m: NonNegative | None = key("a number >= 0 in N/m")
    anchor_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = key(
        "two numbers in m"
    )
    arm_m: Positive | None = key("a positive number in m")
    free_length_m: AnyFloat | None = key("a number in m, below 0 with initial tension")


@record
class Nominal:
    """Nominal values and start hints; compliances in rad/(N m), base rotation (3, 3).

    `settings`: place → key → value of the constants that effects do not fit, in the key's unit.
    `sizes`: place → key → typical deviation of a parameter from nominal, in its SI unit, where
    this arm's is known and the effect's own would not do.
    """

    joint_compliance: Many[NonNegative] | None = keyed(
        "one number >= 0 per joint, in rad/(N m)", form=Compliances, default=None
    )
    base_position: Vector3 | None = keyed("three numbers in m", "base_position_m", default=None)
    base_rotation: Rotation | None = turn_key(
        "three numbers in degrees: roll, pitch, yaw", "base_rpy_deg", default=None
    )
    gravity_compensator: dict[str, Any] | None = keyed(
        'a table with joint = "joint2"',
        form=CompensatorTable,
        into=lambda table, *_: table.model_dump(exclude_none=True),
        default=None,
    )
    settings: dict[str, dict[str, AnyFloat]] = keyed(
        "a table per place, as in settings.joint2 = { jump_time_s = 720.0 }",
        form=dict[str, dict[str, float]],
        default_factory=dict,
    )
    sizes: dict[str, dict[str, Positive]] = keyed(
        "a table per place, as in sizes.joint2 = { move_lag = 0.002 }",
        form=dict[str, dict[str, Positive]],
        default_factory=dict,
    )

    def __post_init__(self) -> None:
        spring = self.gravity_compensator or {"joint": "joint1"}
        listed = {k: list(v) if isinstance(v, tuple) else v for k, v in spring.items()}
        checked(CompensatorTable, listed, "Nominal: gravity_compensator")

    def at(
        self, place: str, settings: Mapping[str, float], sizes: Mapping[str, float] = {}
    ) -> Nominal:
        """The same with these constants, and sizes, of the effects at a place."""
        more = {kind: new for kind, new in (("settings", settings), ("sizes", sizes)) if new}
        known: dict[str, Any] = {kind: dict(getattr(self, kind)) for kind in more}
        for kind, places in known.items():
            places[place] = {**places.get(place, {}), **more[kind]}
        return replace(self, **known)


@record
class ModelSpec:
    """What is observed, which effects are fitted, and what drives and settles the springs.

    `effects` may be stated as texts, "effect" or "effect:where".
    """

    observe: Observe = keyed(default="position")
    effects: Annotated[tuple[EffectChoice, ...], BeforeValidator(_choices)] = keyed(
        'a list of "effect" or "effect:where"', form=list[Text], default=()
    )
    torque: Literal["computed", "measured"] = keyed(default="computed")
    link_gravity: bool = keyed(default=False)
    deflection_model: Literal["equilibrium", "linear"] = keyed(default="equilibrium")
    compliance_levels: dict[str, Many[float]] = keyed(
        "a list of numbers per joint, as in joint2_deg = [-25.2, 0.0]",
        form=dict[str, Numbers],
        into=joint_values,
        default_factory=dict,
    )
    gear_ripple_orders: Many[Positive] = keyed("a list of positive numbers", default=())
    thermal_driver: Literal["time", "temperature"] = keyed(default="time")
    play_side: Literal["load", "load_and_approach"] = keyed(default="load")
    approach: Literal["column", "order"] = keyed(default="column")
    clock: Literal["column", "rows"] = keyed(default="column")
    nominal: Nominal = keyed("a table", default_factory=Nominal)

    def with_effect(
        self, name: str, where: str, settings: Mapping[str, float], sizes: Mapping[str, float] = {}
    ) -> ModelSpec:
        """The same with one effect more, at these constants and of these sizes."""
        nominal = self.nominal.at(where, settings, sizes)
        return replace(self, effects=(*self.effects, EffectChoice(name, where)), nominal=nominal)

    def __post_init__(self) -> None:
        for i, choice in enumerate(self.effects):
            require(
                choice not in self.effects[:i],
                f"key model.effects[{i}] repeats {quoted(str(choice))}; keep one",
            )
        for joint, levels in self.compliance_levels.items():
            require(
                len(set(levels)) == len(levels),
                f"[model.compliance_levels] repeats a level of {joint}; give each once",
            )
