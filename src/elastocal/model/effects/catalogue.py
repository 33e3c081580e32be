"""The catalogue of effects, built in and registered.

An effect is known by its name everywhere; what else other modules must know of it they ask it: see
the traits of `base.Effect`.  A new one is a class in the room of its stage and a line below, or a
file of the user's own that calls `register`.
"""

from __future__ import annotations

from elastocal.errors import require
from elastocal.model.effects import (
    changes_in_time,
    compliances,
    gears,
    gravity_sag,
    loads,
    placements,
    play,
    smooth,
)
from elastocal.model.effects.base import Effect, check
from elastocal.plugin_loader import same_class

# Effects act in this order: what sets a frame or a marker stands before what moves it.
CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        placements.BaseFrame(),
        gears.JointOffset(),
        gears.EncoderScale(),
        gears.GearEccentricity(),
        gears.GearSecondHarmonic(),
        gears.GearRipple(),
        gears.GearSpectrum(),
        smooth.JointCurve(),
        gears.WristCoupling(),
        changes_in_time.JointDrift(),
        changes_in_time.EncoderJump(),
        play.MoveLag(),
        play.MoveHysteresis(),
        gravity_sag.GravitySag(),
        compliances.TorqueCoupling(),
        placements.LinkGeometry(),
        compliances.TorqueTilt(),
        changes_in_time.ThermalExpansion(),
        smooth.ResidualField(),
        compliances.JointCompliance(),
        compliances.JointHardening(),
        play.Backlash(),
        play.Hysteresis(),
        compliances.OffAxisCompliance(),
        compliances.LinkBending(),
        compliances.BaseCompliance(),
        loads.GravityCompensator(),
        loads.LinkGravity(),
        loads.LinkMassError(),
        gravity_sag.LinkWeights(),
        loads.Payload(),
        loads.PayloadError(),
        placements.MarkerPosition(),
        changes_in_time.MarkerSlip(),
        placements.MarkerOrientation(),
        changes_in_time.BaseDrift(),
        changes_in_time.FrameJump(),
        placements.DistanceSensor(),
        placements.TrackerDistortion(),
    )
}
BUILT_IN = frozenset(CATALOGUE)
# Probability that an effect is missing; in equal shares it is each of them, at each of its places.
SOMETHING = 0.5
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
