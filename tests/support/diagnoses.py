"""Diagnoses made by hand, one per verdict, with names that a terminal or a page must not obey."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.cells import table_of

from elastocal.diagnosis.diagnosis import (
    Candidate,
    ComponentShare,
    Curve,
    Diagnosis,
    EffectAt,
    EffectGroup,
    ExtraPlan,
    FaultyReading,
    FittedParameter,
    FoundEffect,
    Gap,
    Location,
    NoiseFloor,
    RivalPair,
    StructureTest,
    Untested,
)
from elastocal.identification.scrutiny import BudgetStep

HOSTILE = "<script>alert(1)</script>\x1b[31m"

ECCENTRICITY = FoundEffect(
    "gear_eccentricity", "joint2", 0.981, 0.752, (0.65, 0.82), (0.63, 0.84),
    (FittedParameter("joint2.eccentricity_sin", 1.12e-4, "rad", 6e-6),
     FittedParameter("joint2.eccentricity_cos", -4.1e-5, "rad", 7e-6)), {},
)  # fmt: skip
JUMP = FoundEffect(
    "encoder_jump", "joint1", 0.91, 0.12, (0.06, 0.18), (0.05, 0.19),
    (FittedParameter("joint1.jump", 1.4e-4, "rad", 1.1e-5),), {"jump_time_s": 4325.5},
)  # fmt: skip

CANDIDATES = (
    Candidate("gear_eccentricity", "joint2", "transmission", 0.981, 161.4, 21.0, {}),
    Candidate("link_mass_error", "link2", "load", 0.012, 157.0, 9.4, {}),
    Candidate("gravity_compensator", "joint2", "load", 0.004, 155.8, 14.0, {}),
    Candidate("encoder_jump", "joint1", "transmission", 0.002, 12.5, 17.0, {"jump_time_s": 4325.5}),
    Candidate("gear_ripple", "joint3", "transmission", 0.0004, 3.1, 6.2, {"ripple_order": 100.7}),
    Candidate("encoder_scale", "joint4", "transmission", 1e-6, -0.4, 4.4, {}),
    Candidate("marker_slip", f"marker:{HOSTILE}", "tool", 1e-7, -1.2, 11.0, {"slip_time_s": 60.0}),
    Candidate("thermal_expansion", "all", "geometry", 1e-8, -2.2, 2.1, {"time_constant_s": 1800.0}),
    Candidate("link_bending", "link6", "compliance", 1e-9, -3.5, 0.2, {}),
    Candidate("base_compliance", "base", "compliance", 1e-9, -3.9, 0.0, {}),
)

STRUCTURE = (
    StructureTest("load", 0.71, 1.0),
    StructureTest("joint2 angle", 0.0005, 0.004),
    StructureTest("joint3 torque", 0.03, 0.31),
)

LOCATION = Location(
    "transmission", "joint2", 0.984, {"transmission": 0.984, "load": 0.015, "compliance": 0.001},
    {"joint2": 0.985, "link2": 0.012, f"marker:{HOSTILE}": 0.003}, {"joint2 angle": 0.0005},
)  # fmt: skip

FAULTY = FaultyReading(41, HOSTILE, "M1", 0.4e-3, 22.0), FaultyReading(88, "29", "M3", 1.3e-3, 71.0)
NOISE = NoiseFloor(
    stated=True, stated_factor=1.12, ratio_to_stated=1.2, reading_sigma=18.4e-6,
    repeatability=(6.1e-6, 5.2e-6, 7.0e-6, 0.0, 9.4e-6, 4.4e-6), shared=0.5,
    pure_error=17.6e-6, faulty=FAULTY,
)  # fmt: skip

EXPLAINED = Diagnosis(
    verdict="explained",
    gap=Gap(nominal=3.2e-3, calibrated=84e-6, explained=21e-6, noise_floor=19e-6),
    budget=(
        BudgetStep("nominal", 3.2e-3, (2.9e-3, 3.5e-3)),
        BudgetStep("base_frame", 1.9e-3, (1.7e-3, 2.1e-3)),
        BudgetStep("joint_offset", 410e-6, (360e-6, 450e-6)),
        BudgetStep("joint_compliance", 84e-6, (71e-6, 97e-6)),
        BudgetStep("gear_eccentricity:joint2", 21e-6, (19e-6, 23e-6)),
        BudgetStep("noise_floor", 19e-6, (19e-6, 19e-6)),
    ),
    effects=(ECCENTRICITY,),
    candidates=CANDIDATES,
    indistinguishable=(),
    location=LOCATION,
    noise=NOISE,
    structure=STRUCTURE,
    probability_nothing=1e-12,
    probability_unknown=0.001,
    p_value=0.0004,
    untested=tuple(
        Untested("hysteresis", joint, "the table has no approach direction",
                 "record the direction of the last motion (approach_1 …) and repeat poses from "
                 "both sides")
        for joint in ("joint1", "joint2")
    ),
    warnings=(f"marker {HOSTILE} was seen in 3 poses only",),
    n_readings=360,
    n_configurations=60,
)  # fmt: skip

TWO = replace(EXPLAINED, effects=(ECCENTRICITY, JUMP))

RIVALS = ((EffectAt("gear_eccentricity", "joint2"), EffectAt("link_mass_error", "link2")),)
AMBIGUOUS = replace(
    EXPLAINED,
    verdict="ambiguous",
    effects=(replace(ECCENTRICITY, probability=0.58),),
    candidates=(
        replace(CANDIDATES[0], probability=0.58),
        replace(CANDIDATES[1], probability=0.41),
        *CANDIDATES[2:],
    ),
    indistinguishable=RIVALS,
)

# Where nothing of the catalogue is at work, none of it is likely.
UNLIKELY = tuple(replace(c, probability=c.probability * 0.02, score=-1.0) for c in CANDIDATES)

NOTHING = replace(
    EXPLAINED,
    verdict="nothing_significant",
    gap=replace(EXPLAINED.gap, calibrated=24e-6, explained=24e-6, noise_floor=23e-6),
    budget=(*EXPLAINED.budget[:-3], BudgetStep("joint_compliance", 24e-6, (21e-6, 27e-6))),
    effects=(),
    candidates=UNLIKELY,
    location=None,
    structure=(StructureTest("joint2 angle", 0.2, 0.86), StructureTest("load", 0.71, 1.0)),
    probability_nothing=0.93,
    probability_unknown=0.02,
    p_value=0.41,
)

X = np.linspace(-2.4, 0.6, 40)
UNKNOWN = replace(
    EXPLAINED,
    verdict="unknown_effect",
    effects=(),
    candidates=UNLIKELY,
    budget=(*EXPLAINED.budget[:-2], EXPLAINED.budget[-1]),
    probability_unknown=0.97,
    curves=(
        Curve("joint2 angle", "rad", "joint 2 rotation", "rad", tuple(X),
              tuple(8e-5 * np.sin(3 * X)), tuple(2e-5 + 1e-5 * X**2)),
        Curve("time", "s", HOSTILE, "m", (0.0, 3600.0, 7200.0), (0.0, 4e-5, 5e-5),
              (1e-5, 5e-6, 1e-5)),
    ),
)  # fmt: skip


# Rivals that no pose tells apart.
INSEPARABLE = ExtraPlan(
    rivals=("gear_eccentricity:joint2", "link_mass_error:link2"),
    pairs=(RivalPair("gear_eccentricity:joint2", "link_mass_error:link2", 1.1, 5.6),),
    plan=None,
    n_poses=0,
    probability_before=0.69,
    probability_after=0.69,
    probability_random=0.85,
    separable=False,
    inseparable=(("gear_eccentricity:joint2", "link_mass_error:link2"),),
    advice=(f"pull sideways as well {HOSTILE}",),
)

EXTRA = replace(
    INSEPARABLE, plan=table_of(np.zeros((2, 6)), np.zeros(3), ("M1",)), n_poses=2,
    probability_after=0.997, separable=True, inseparable=(),
)  # fmt: skip

# Many causes at once: errors of three gears, sag at two joints, and a creep that nobody can name.


def curve(joint: int, size: float) -> FoundEffect:
    settings = {
        "curve_low_rad": -2.9, "curve_high_rad": 0.5, "curve_size_rad": size,
        "curve_length_rad": 0.07,
    }  # fmt: skip
    return FoundEffect(
        "joint_curve", f"joint{joint}", 0.999, 0.2, (0.18, 0.22), (0.17, 0.23), (), settings
    )


def part(family: str, where: str, effects: tuple[str, ...], share: float, p: float = 0.999):
    rms = 426e-6 * share**0.5
    return ComponentShare(
        family, where, effects, share, (0.9 * share, 1.1 * share), rms, (0.94 * rms, 1.06 * rms),
        p, effects != ("residual_field",),
    )  # fmt: skip


JOINTS = ("joint1", "joint2", "joint5")
MANY = replace(
    EXPLAINED,
    gap=replace(EXPLAINED.gap, calibrated=426e-6, explained=137e-6, noise_floor=61e-6),
    budget=(
        *EXPLAINED.budget[:2],
        BudgetStep("geometry", 426e-6, (384e-6, 472e-6)),
        BudgetStep("gear_errors:joint1+joint2+joint5", 213e-6, (156e-6, 290e-6)),
        BudgetStep("gravity_sag:joint2+joint3", 137e-6, (104e-6, 179e-6)),
        BudgetStep("noise_floor", 61e-6, (61e-6, 61e-6)),
    ),
    effects=(
        curve(2, 3.2e-4), curve(1, 3.3e-4),
        FoundEffect("gravity_sag", "joint3", 0.99, 0.02, (0.01, 0.03), (0.0, 0.04), (),
                    {"sag_size_rad": 2.2e-4}),
        FoundEffect("gravity_sag", "joint2", 0.98, 0.01, (0.0, 0.02), (0.0, 0.02), (),
                    {"sag_size_rad": 2.1e-4}),
        replace(ECCENTRICITY, where="joint5", probability=0.58),
    ),
    indistinguishable=(),
    components=(
        part("angle", "joint2", ("joint_curve",), 0.55),
        part("angle", "joint1", ("joint_curve",), 0.25),
        part("gravity", "joint3", ("gravity_sag",), 0.10),
        part("gravity", "joint2", ("gravity_sag",), 0.03),
        part("angle", "joint5", ("gear_eccentricity",), 0.016),
    ),
    groups=(
        EffectGroup("gear_errors", JOINTS, ("joint_curve", "gear_eccentricity"), 0.82, (0.79, 0.85),
                    0.54, (0.52, 0.56)),
        EffectGroup("gravity_sag", ("joint2", "joint3"), ("gravity_sag",), 0.12, (0.09, 0.15),
                    0.009, (0.002, 0.016)),
    ),
    curves=tuple(
        Curve(f"joint{j} angle", "rad", f"joint{j}", "rad", tuple(X), tuple(3e-4 * np.sin(9 * X)),
              (2e-5,) * len(X))
        for j in (1, 2)
    ),
    location=replace(LOCATION, shares={"transmission": 0.97, "tracker": 0.05}),
)  # fmt: skip
CREEP = FoundEffect(
    "residual_field", "base", 0.99, 0.05, (0.03, 0.07), (0.02, 0.08), (),
    {"field_time_size": 4e-5, "field_time_length": 5400.0, "field_time_low": 0.0,
     "field_time_high": 28800.0},
)  # fmt: skip
MANY_AMBIGUOUS = replace(
    MANY,
    verdict="ambiguous",
    indistinguishable=((EffectAt("gear_eccentricity", "joint5"),
                        EffectAt("gear_second_harmonic", "joint5")),),
)  # fmt: skip
MANY_UNKNOWN = replace(
    MANY,
    verdict="unknown_effect",
    budget=(*MANY.budget[:-1], BudgetStep("unknown:base", 90e-6, (80e-6, 100e-6)), MANY.budget[-1]),
    components=(*MANY.components, part("time", "base", ("residual_field",), 0.11)),
    fields=(CREEP,),
)

VERDICTS = {
    "explained": EXPLAINED,
    "two": TWO,
    "ambiguous": AMBIGUOUS,
    "planned": replace(AMBIGUOUS, extra=EXTRA),
    "inseparable": replace(AMBIGUOUS, extra=INSEPARABLE),
    "nothing": NOTHING,
    "none named": replace(NOTHING, probability_nothing=0.004),
    "unknown": UNKNOWN,
    "unlocated": replace(UNKNOWN, location=None, curves=(), structure=()),
    "many": MANY,
    "many ambiguous": MANY_AMBIGUOUS,
    "many unknown": MANY_UNKNOWN,
}
