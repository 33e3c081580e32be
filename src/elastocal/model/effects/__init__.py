"""The catalogue of effects, built in and registered.

An effect is known by its name everywhere; what else other modules must know of it they ask it: see
the traits of `base.Effect`.  A new one is a class in the room of its stage and a line below, or a
file of the user's own that calls `register`.
"""

from __future__ import annotations

from elastocal.errors import require
from elastocal.model.effects.base import Effect, check
from elastocal.model.effects.changes_in_time import (
    BaseDrift,
    EncoderJump,
    FrameJump,
    JointDrift,
    MarkerSlip,
    ThermalExpansion,
)
from elastocal.model.effects.compliances import (
    BaseCompliance,
    JointCompliance,
    JointHardening,
    LinkBending,
    OffAxisCompliance,
)
from elastocal.model.effects.gears import (
    EncoderScale,
    GearEccentricity,
    GearRipple,
    GearSecondHarmonic,
    GearSpectrum,
    JointOffset,
    WristCoupling,
)
from elastocal.model.effects.gravity_sag import GravitySag, LinkWeights
from elastocal.model.effects.loads import (
    GravityCompensator,
    LinkGravity,
    LinkMassError,
    Payload,
    PayloadError,
)
from elastocal.model.effects.placements import (
    BaseFrame,
    DistanceSensor,
    LinkGeometry,
    MarkerOrientation,
    MarkerPosition,
)
from elastocal.model.effects.play import Backlash, Hysteresis, MoveLag
from elastocal.model.effects.smooth import JointCurve, ResidualField
from elastocal.model.effects.torque_couplings import TorqueCoupling, TorqueTilt
from elastocal.model.effects.tracker_distortion import TrackerDistortion
from elastocal.plugin_loader import same_class

# Effects act in this order: what sets a frame or a marker stands before what moves it.
CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        BaseFrame(),
        JointOffset(),
        EncoderScale(),
        GearEccentricity(),
        GearSecondHarmonic(),
        GearRipple(),
        GearSpectrum(),
        JointCurve(),
        WristCoupling(),
        JointDrift(),
        EncoderJump(),
        MoveLag(),
        GravitySag(),
        TorqueCoupling(),
        LinkGeometry(),
        TorqueTilt(),
        ThermalExpansion(),
        ResidualField(),
        JointCompliance(),
        JointHardening(),
        Backlash(),
        Hysteresis(),
        OffAxisCompliance(),
        LinkBending(),
        BaseCompliance(),
        GravityCompensator(),
        LinkGravity(),
        LinkMassError(),
        LinkWeights(),
        Payload(),
        PayloadError(),
        MarkerPosition(),
        MarkerSlip(),
        MarkerOrientation(),
        BaseDrift(),
        FrameJump(),
        DistanceSensor(),
        TrackerDistortion(),
    )
}
BUILT_IN = frozenset(CATALOGUE)
UNKNOWN = Effect()  # what is known of an effect that the catalogue does not have


def effect_of(name: str) -> Effect:
    """The effect of that name for its traits; one with their defaults where there is none."""
    return CATALOGUE.get(name, UNKNOWN)


def register(effect: Effect) -> None:
    """Add an effect to the catalogue, behind the last one of its stage.

    Raises InputError where it is no effect, says too little, or has the name of another one; the
    same class (in an edited notebook cell, say) takes the place of its former self.
    """
    check(effect)
    known = CATALOGUE.get(effect.name)
    if known is not None:
        require(
            effect.name not in BUILT_IN and same_class(known, effect),
            f"there is an effect '{effect.name}' already; choose another name",
        )
        CATALOGUE[effect.name] = effect
        return
    order = list(CATALOGUE.values())
    last = max(k for k, other in enumerate(order) if other.stage == effect.stage)
    order.insert(last + 1, effect)
    CATALOGUE.clear()
    CATALOGUE.update({each.name: each for each in order})
