"""The tables of a cell: arm, what it carries, what measures it, the model of it, and [design], what
the user asks of a plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from elastocal.config import (
    DISTINCT,
    AnyFloat,
    Count,
    File,
    Key,
    Levels,
    Many,
    NonNegative,
    Numbers,
    Positive,
    Positives,
    Record,
    Rotation,
    Spot,
    Table,
    Text,
    Vector3,
    by_name,
    checked,
    existing_file,
    fields_of,
    file_key,
    from_table,
    holding,
    joint_values,
    key,
    keyed,
    keys_of,
    numbers,
    optional,
    several,
    stated,
    turn_key,
)
from elastocal.messages import is_label, listed, quoted, require, wish
from elastocal.units import Array

Observe = Literal["position", "deflection", "pose", "distance"]
Convention = Literal["standard", "modified"]
Sigma = Annotated[Array, numbers(3, above=0, one_for_all=True)]
Speeds = Annotated[Array, numbers(above=0, one_for_all=True)]
Scatter = Annotated[Array, numbers(least=0, one_for_all=True)]
Compliances = Annotated[Many[NonNegative], Field(min_length=1)]
Effects = Annotated[list[Text], DISTINCT]
ZEROS = partial(np.zeros, 3)
SOURCES = ("urdf", "mjcf", "dh")  # keys of [robot] that state the nominal arm
POLAR_KEYS = ("range_um", "range_ppm", "transverse_um", "transverse_ppm")
OF_THE_FILE = "the name of a link of the URDF, or of a body{} of the MuJoCo model"


class Robot(Record):
    """A URDF or a MuJoCo model with the names of its first and last link, or a DH table.

    `masses`: the table of link masses of a DH robot.  `dh` takes a UR's factory calibration too: a
    YAML of ur_calibration, or a calibration.conf with `ur_model`.  `joint_names` says what jointN
    means where the file has such a name at another place.  Files as absolute or relative paths.

    Examples:
        >>> robot = ec.Robot.from_urdf("kr270_2.urdf", flange="flange")
        >>> ec.Model(ec.Cell(name="bare arm", robot=robot)).chain.n_joints
        6
    """

    urdf: File | None = file_key(takes='the path of a URDF file, e.g. "arm.urdf"')
    mjcf: File | None = file_key(takes='the path of a MuJoCo model, e.g. "arm.xml"')
    base: Text | None = optional(takes=OF_THE_FILE.format(""))
    flange: Text | None = optional(takes=OF_THE_FILE.format(" or site"))
    dh: File | None = file_key(takes='the path of a DH table, e.g. "dh.csv"')
    dh_convention: Convention = keyed(default="standard")
    masses: File | None = file_key(takes='a table of link masses, e.g. "links.csv"')
    ur_model: Text | None = optional(takes='a Universal Robot, e.g. "UR10e"')
    joint_names: Literal["order", "file"] | None = optional(
        note=": whether jointN is the Nth joint, or one of that name in the robot's file"
    )

    def __post_init__(self) -> None:
        given = [name for name in SOURCES if getattr(self, name) is not None]
        told = f"{listed(given)} are given"
        require(len(given) < 2, f"[robot] takes exactly one of {listed(SOURCES)}; {told}")

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        given = [name for name in SOURCES if name in table]
        require(given, f"[robot] takes exactly one of {listed(SOURCES)}; none is given")
        of_a_table = ("dh_convention", "masses", "ur_model")
        other = {"urdf": of_a_table, "mjcf": of_a_table, "dh": ("base", "flange")}
        for name in other[given[0]] if len(given) == 1 else ():
            told = f"key robot.{name} has no meaning beside {given[0]}; drop it"
            require(name not in table, told)
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

        Examples:
            >>> ec.Robot.from_dh("dh.csv", convention="modified").dh_convention
            'modified'
        """
        links = None if masses is None else Path(masses)
        return cls(dh=Path(path), dh_convention=convention, masses=links)


class Tool(Record):
    """`load_point` (3,) and `markers` name → (3,), in m in the flange frame.

    Examples:
        >>> tool = ec.Tool(load_point=[0.2, 0.0, 0.25], markers={"M1": [0.25, 0.0, 0.05]})
        >>> tool.markers["M1"]
        array([0.25, 0.  , 0.05])
    """

    load_point: Vector3 = keyed("load_point_m", note=", in the flange frame", default_factory=ZEROS)
    markers: dict[str, Vector3] = by_name("markers_m", note=" per marker, in the flange frame")

    def __post_init__(self) -> None:
        for name in self.markers:
            require(
                is_label(name),
                f"marker name {quoted(name)} in [tool.markers_m] cannot stand in a table; use a "
                "non-empty text on one line without blanks at its ends or what cannot be seen",
            )


class CartesianNoise(Record):
    """Standard deviations (3,) in m along x, y, z of the tracker frame; one number for all."""

    sigma: Sigma = keyed("sigma_um", note=", or three for x, y, z", required=False)


class PolarNoise(Record):
    """Range and transverse standard deviation: constant part in m, part per metre of range (1)."""

    range: Positive = keyed("range_um", required=False)
    range_per_m: NonNegative = keyed("range_ppm", required=False)
    transverse: Positive = keyed("transverse_um", required=False)
    transverse_per_m: NonNegative = keyed("transverse_ppm", required=False)


class Tracker(Record):
    """`position` (3,) m: where the instrument stands in the frame of the data.

    `anchor` (3,) m: nominal cable or ball-bar anchor for distances.
    `rotation_sigma` rad and `distance_sigma` m: noise of pose and distance readings, if known.

    Examples:
        >>> from elastocal.cell_tables import CartesianNoise
        >>> ec.Tracker(position=[3.0, 0.0, 1.5], noise=CartesianNoise(sigma=[1e-5] * 3)).noise.sigma
        array([1.e-05, 1.e-05, 1.e-05])
    """

    position: Vector3 = keyed("position_m", default_factory=ZEROS)
    noise: CartesianNoise | PolarNoise | None = optional(keys=keys_of(CartesianNoise, PolarNoise))
    anchor: Vector3 | None = optional("anchor_m")
    rotation_sigma: Positive | None = optional("rotation_urad")
    distance_sigma: Positive | None = optional("distance_um")

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        polar, cartesian = [name for name in POLAR_KEYS if name in table], "sigma_um" in table
        if not polar:
            return {"noise": from_table(CartesianNoise, table, spot) if cartesian else None}
        require(
            not cartesian,
            f"keys tracker.sigma_um and tracker.{polar[0]} are two styles of noise; keep sigma_um, "
            f"or {', '.join(POLAR_KEYS)}",
        )
        for name in ("range_um", "transverse_um"):
            require(
                name in table,
                f"key tracker.{name} is missing; beside tracker.{polar[0]} it takes a positive "
                "number in µm",
            )
        known = {"range_ppm": 0.0, "transverse_ppm": 0.0}
        return {"noise": from_table(PolarNoise, known | table, spot)}


class Unsteadiness(Record):
    """What differs from visit to visit, beside the noise of a reading, and the tails of that noise.

    `joints` (joints,) or (1,), in rad or m: by how much each joint settles elsewhere at each visit.
    `drift` m in each direction: of base or tracker, with the correlation exp(−|t − t′|/`lasting`)
    of times in s.  `configuration` m in each direction: a deviation that all readings of a
    configuration share, whatever the load.  `tails`: degrees of freedom of Student's t, of which
    the noise of a reading is drawn, its standard deviation the stated one; None: normal.
    """

    joints: Scatter = keyed(
        "joints_urad", takes="a number >= 0 in µrad (µm where a joint slides), or one per joint",
        default_factory=partial(np.zeros, 1),
    )  # fmt: skip
    drift: NonNegative = keyed("drift_um", default=0.0)
    lasting: Positive = keyed("lasting_s", default=3600.0)
    configuration: NonNegative = keyed("configuration_um", default=0.0)
    tails: Annotated[float, Field(gt=2)] | None = optional(
        takes="a number > 2, as 3: with two degrees of freedom or fewer Student's t has no "
        "standard deviation, which is what [tracker] states"
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


class EffectChoice(Record):
    """One entry of `effects`: "joint_compliance", or "joint_compliance:joint2" for one place."""

    name: str
    where: str | None = None

    @classmethod
    def parse(cls, entry: str) -> EffectChoice:
        """The choice that "effect" or "effect:where" states."""
        name, colon, where = entry.partition(":")
        ok = name and (where or not colon) and entry == entry.strip()
        require(ok, f'key model.effects takes "effect" or "effect:where"; found {quoted(entry)}')
        return cls(name, where or None)

    def __str__(self) -> str:
        return f"{self.name}:{self.where}" if self.where else self.name


def _choices(entries: object) -> object:
    if not isinstance(entries, list | tuple):
        return entries
    return tuple(EffectChoice.parse(one) if isinstance(one, str) else one for one in entries)


class CompensatorTable(Table):
    """A spring between two anchor points that takes a part of a joint's load."""

    joint: Text = key('the joint the spring spans, e.g. "joint2"', ...)
    stiffness_N_per_m: NonNegative | None = key("a number >= 0 in N/m")
    anchor_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = key(
        "two numbers in m"
    )
    arm_m: Positive | None = key("a positive number in m")
    free_length_m: AnyFloat | None = key("a number in m, below 0 with initial tension")


class Nominal(Record):
    """Nominal values and start hints; compliances in rad/(N m), base rotation (3, 3).

    `settings`: place → key → value of the constants that effects do not fit, in the key's unit.
    `sizes`: place → key → typical deviation of a parameter from nominal, in its SI unit, where
    this arm's is known and the effect's own would not do.
    """

    joint_compliance: Many[NonNegative] | None = optional(
        note=" per joint, in rad/(N m)", form=Compliances
    )
    base_position: Vector3 | None = optional("base_position_m")
    base_rotation: Rotation | None = turn_key("base_rpy_deg", note=": roll, pitch, yaw")
    gravity_compensator: dict[str, Any] | None = optional(
        takes='a table with joint = "joint2"',
        form=CompensatorTable,
        into=lambda table, *_: table.model_dump(exclude_none=True),
    )
    settings: dict[str, dict[str, AnyFloat]] = by_name(
        takes="a table per place, as in settings.joint2 = { jump_time_s = 720.0 }",
        form=dict[str, dict[str, float]],
    )
    sizes: dict[str, dict[str, Positive]] = by_name(
        takes="a table per place, as in sizes.joint2 = { move_lag = 0.002 }"
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


class ModelSpec(Record):
    """What is observed, which effects are fitted, and what drives and settles the springs.

    `effects` may be stated as texts, "effect" or "effect:where".
    """

    observe: Observe = keyed(default="position")
    effects: Annotated[tuple[EffectChoice, ...], BeforeValidator(_choices), DISTINCT] = several(
        takes='a list of "effect" or "effect:where", each once', form=Effects
    )
    torque: Literal["computed", "measured"] = keyed(default="computed")
    link_gravity: bool = keyed(default=False)
    deflection_model: Literal["equilibrium", "linear"] = keyed(default="equilibrium")
    compliance_levels: dict[str, Levels] = by_name(
        note=" per joint, each once, as in joint2_deg = [-25.2, 0.0]",
        form=dict[str, Annotated[Numbers, DISTINCT]],
        into=joint_values,
    )
    gear_ripple_orders: Many[Positive] = several(takes="a list of positive numbers")
    thermal_driver: Literal["time", "temperature"] = keyed(default="time")
    play_side: Literal["load", "load_and_approach"] = keyed(default="load")
    approach: Literal["column", "order"] = keyed(default="column")
    clock: Literal["column", "rows"] = keyed(default="column")
    nominal: Nominal = keyed(default_factory=Nominal)

    def with_effect(
        self, name: str, where: str, settings: Mapping[str, float], sizes: Mapping[str, float] = {}
    ) -> ModelSpec:
        """The same with one effect more, at these constants and of these sizes."""
        nominal = self.nominal.at(where, settings, sizes)
        return replace(self, effects=(*self.effects, EffectChoice(name, where)), nominal=nominal)


TEST_POSE = "test_pose"  # the criterion where none is asked for
EXTRA_TIME = 0.05  # of the shortest time, for a longer way where none is stated
ELSEWHERE_CAP = 0.05  # where the user states no test poses: a price that buys most of what can be
FORCE = partial(optional, "load_N", note=", a force in the data's frame")
POINT = partial(optional, "point_m", note=", a point in the flange frame")


class TargetPose(Record):
    """A test pose, where position must be right: joints `q` (n,) rad or m and force (3,) N.

    `point` (3,) m in the flange frame; None: the markers themselves where their places are fitted,
    else the load point if the cell states one, else the mean over the markers.  `force` None: each
    of the design's loads that is not zero.  `degrees`: q was stated in degrees, which fits
    revolute joints only.
    """

    q: Numbers = keyed("q_deg", "q_si", note=", one per joint")
    force: Vector3 | None = FORCE()
    weight: Positive = keyed(default=1.0)
    point: Vector3 | None = POINT()
    degrees: bool = False

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        return {"degrees": "q_deg" in table}


class TargetPath(Record):
    """A table of poses: q1_deg … (force_x_N …), or x_mm, y_mm, z_mm (rx_deg …) of the point."""

    file: File = keyed(
        takes='the path of a table of poses, e.g. "path.csv"', form=Text, into=existing_file
    )
    force: Vector3 | None = FORCE()
    point: Vector3 | None = POINT()


class TargetBox(Record):
    """`count` test poses with the point inside a box (m, data's frame), sampled.

    `rotation` (3, 3) of the flange in the data's frame, None for any that the arm reaches.
    """

    lower: Vector3 = keyed("lower_m", note=", a corner in the data's frame")
    upper: Vector3 = keyed("upper_m", note=", the opposite corner")
    count: Annotated[int, Field(ge=1, le=10_000)] = keyed(note=" from 1 to 10000", default=20)
    rotation: Rotation | None = turn_key("rpy_deg", note=": roll, pitch, yaw of the flange")
    force: Vector3 | None = FORCE()
    point: Vector3 | None = POINT()

    def __post_init__(self) -> None:
        k = int(np.argmin(self.lower < self.upper))
        require(
            self.lower[k] < self.upper[k],
            f"{wish('test_box', '[design.test_box]')} takes lower_m < upper_m in x, y and z; "
            f"found {self.lower[k]:g} and {self.upper[k]:g} in {'xyz'[k]}; swap or correct them",
        )


class Motion(Record):
    """How the arm moves between poses: joint `speed` (n,) rad/s or m/s, (1,) where all are alike
    (None: equal speeds), `home` (n,), `dwell` s of a stop and `reading` s more for each reading of
    a marker in it, `load_change` s for hanging or taking off the load by hand, `both_directions`:
    approach every pose from both sides (`overshoot` rad), to show backlash. `load_changes`: how
    often at most the load may be hung, exchanged or taken off (None: as rarely as can be),
    `extra_time`: how much longer than by the shortest way all may take so that a drift does less
    (0: the shortest order; None: a little, and as much as pays for reading poses twice);
    `reference_every`: after so many visits one pose is visited again. `degrees`: speed or home were
    stated in degrees, which fits revolute joints only."""

    speed: Positives | None = optional(
        keys=[Key("speed_deg_per_s", note=", or one per joint", form=Speeds),
              Key("speed_si", "one positive number per joint, in rad/s or m/s", form=Positives)]
    )  # fmt: skip
    home: Numbers | None = optional("home_deg", "home_si", note=", one per joint")
    dwell: NonNegative = keyed("dwell_s", default=30.0)
    reading: NonNegative = keyed("reading_s", default=0.0)
    load_change: NonNegative = keyed("load_change_s", default=600.0)
    both_directions: bool = keyed(default=False)
    overshoot: Positive = keyed("overshoot_deg", default=0.05)
    load_changes: Count | None = optional()
    extra_time: NonNegative | None = optional(note=", a share of the time")
    reference_every: Count | None = optional()
    degrees: bool = False

    @property
    def longer(self) -> float:
        """The share of time by which the way may be longer than the shortest."""
        return EXTRA_TIME if self.extra_time is None else self.extra_time

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """Whether speed and home are in degrees; both must be, or none."""
        given = [stated(table, spot, fields_of(cls)[name]) for name in ("speed", "home")]
        names = [one[1] for one in given if one is not None]
        degrees = [not name.endswith("_si") for name in names]
        require(
            all(degrees) or not any(degrees),
            f"keys {' and '.join(map(spot.key, names))} mix units; give both in degrees, or both "
            "in SI units (_si)",
        )
        return {"degrees": any(degrees)}


Box = Annotated[Array, numbers(2, 3), holding(lambda ends: bool((ends[0] <= ends[1]).all()))]
BOX = "two corners in m, the lower first, as in [[0.1, -0.2, 0.1], [0.3, 0.2, 0.3]]"


class Freedom(Record):
    """What may still be chosen before measuring: boxes (2, 3) m, lower and upper corner, for
    `markers` by name and the `load_point` (flange frame) and for the `tracker` (data's frame), and
    how many of the design's `loads` that are not zero will hang."""

    markers: dict[str, Box] = by_name("markers_m", takes=f"per marker {BOX}")
    load_point: Box | None = optional("load_point_m", takes=BOX)
    tracker: Box | None = optional("tracker_m", takes=BOX)
    loads: Count | None = optional()


CANDIDATES = (
    'a whole number >= 1, a file of poses, as in "taught.csv", or both, as in ["taught.csv", 2000]'
)


def of_candidates(given: Any) -> tuple[int | None, str | Path | None] | None:
    """The number of poses to draw and the file of poses that are brought; None where it is neither,
    nor one of each."""
    parts = list(given) if isinstance(given, list | tuple) else [given]
    numbers = [p for p in parts if isinstance(p, int) and not isinstance(p, bool) and p > 0]
    files = [p for p in parts if isinstance(p, str | Path)]
    if len(numbers) > 1 or len(files) > 1 or len(numbers) + len(files) < len(parts) or not parts:
        return None
    return next(iter(numbers), None), next(iter(files), None)


class LevelsTable(Table):
    """One joint's levels under a key such as joint2_deg, and how many poses each gets."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Annotated[Numbers, DISTINCT]] = Field(init=False)
    poses_per_level: Count | Annotated[list[Count], Field(min_length=1)] | None = key(
        "a whole number >= 1, or one per level"
    )


class DesignSpec(Record):
    """`criterion`: the name of one that planning has.

    `levels` joint → values and `per_level` their numbers of poses (for at most one joint); `loads`
    (L, 3) N: forces under which poses are measured, `load_states`: all of them at every pose, or
    chosen ones; `repeats` readings each.  `repeatability` m: standard deviation of a deviation
    common to the readings of a stop, per direction; `marker_sigma` m per marker instead of the
    tracker's noise; `interest`: parameters, places or effects that D, A, E and O count (default all
    but base and markers); `elsewhere`: the share of the weight that poses all over the joint ranges
    have beside the test poses; `elsewhere_cap`: by how much the test poses may be worse for as
    little error there as can be had (see `cap`); `combination` name → factor for c; `candidates` to
    draw, and `taught`: a table of poses that are brought, instead of these or beside them."""

    poses: Count | None = optional()
    criterion: Text = keyed(
        takes='the name of a planning criterion, as "test_pose" or "D"', default=TEST_POSE
    )
    levels: dict[str, Levels] = by_name(
        takes="a list of numbers per joint, each once, as in joint2_deg = [-25.2, 0.0]",
        form=LevelsTable,
    )
    per_level: Many[Count] = ()
    repeats: Count = keyed(default=1)
    loads: Annotated[Array, numbers(None, 3), DISTINCT] | None = optional(
        "loads_N",
        takes="a list of forces in N, each once ([design] repeats says how often each is read), "
        "as in [[0, 0, 0], [0, 0, -2600]]",
    )
    repeatability: NonNegative = keyed("repeatability_um", default=0.0)
    marker_sigma: dict[str, Positive] = by_name("marker_sigma_um", note=" per marker")
    interest: Many[Text] = several(takes='a list of names, as in ["joint_compliance", "joint2"]')
    combination: dict[str, float] = by_name(
        takes='factors by parameter, with names in quotes, as in { "joint2.compliance" = 1.0 }'
    )
    load_states: Literal["all", "chosen"] = keyed(default="all")
    prior: Literal["none", "typical"] = keyed(default="none")
    elsewhere: Annotated[float, Field(ge=0, lt=1)] | None = optional(
        takes="a number from 0 to below 1"
    )
    elsewhere_cap: NonNegative | None = optional(note=", as in 0.05")
    candidates: Count | None = optional(
        takes=CANDIDATES, form=Annotated[Count | Text | list[Count | Text], holding(of_candidates)]
    )
    taught: File | None = None
    target: Positive | None = optional("target_um")
    minutes: Positive | None = optional()
    test_poses: Many[TargetPose] = several("test_pose")
    test_path: TargetPath | None = optional()
    test_box: TargetBox | None = optional()
    motion: Motion = keyed(default_factory=Motion)
    choose: Freedom | None = optional()

    def __post_init__(self) -> None:
        joints, levels = " and ".join(self.levels), wish("levels", "[design.levels]")
        require(
            len(self.levels) < 2,
            f"{levels} has levels of {joints}; only one joint can have levels: keep one, and "
            "narrow the others in [limits]",
        )
        require(
            self.minutes is None or self.target is None,
            "keys design.minutes and design.target_um both ask for the number of poses; drop one",
        )
        require(
            not self.combination or any(self.combination.values()),
            f"{wish('combination', 'key design.combination')} has no factor other than zero; "
            "give the combination of parameters that is to be known well",
        )
        require(
            not (self.elsewhere and self.elsewhere_cap),
            f"{wish('elsewhere', 'keys design.elsewhere')} and "
            f"{wish('elsewhere_cap', 'design.elsewhere_cap')} both say what the joint ranges are "
            "worth beside the test poses; drop one",
        )

    @property
    def states_test_poses(self) -> bool:
        return bool(self.test_poses) or self.test_path is not None or self.test_box is not None

    @property
    def cap(self) -> float:
        """By how much ρ₀ may exceed the least, for as little error all over the joint ranges as
        can be had; 0 where `elsewhere` gives that a weight, or nobody asks for it."""
        if self.elsewhere_cap is not None or self.criterion != TEST_POSE:
            return self.elsewhere_cap or 0.0
        return 0.0 if self.elsewhere is not None or self.states_test_poses else ELSEWHERE_CAP

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """The levels and their numbers of poses, whose sum stands for poses; that they fit is for
        who plans."""
        given = table.get("levels") or LevelsTable()
        levels = joint_values(given.model_extra or {}, spot, "levels", ("poses_per_level",))
        each, n = given.poses_per_level, sum(map(len, levels.values()))
        told = "key design.levels.poses_per_level has no meaning without levels; name the joint"
        require(levels or each is None, f"{told}, as in joint2_deg = [-90, -45, 0]")
        per_level = (each,) * n if isinstance(each, int) else tuple(each or ())
        poses, told = table.get("poses"), f"[design.levels] sum to {sum(per_level)}; drop one"
        require(
            not per_level or poses in (None, sum(per_level)),
            f"key design.poses is {poses}, but the poses per level in {told} or correct it",
        )
        known = {"levels": levels, "per_level": per_level, "poses": sum(per_level) or poses}
        if "candidates" in table:
            known["candidates"], taught = of_candidates(table["candidates"]) or (None, None)
            if taught is not None:
                known["taught"] = existing_file(str(taught), spot, "candidates")
        return known
