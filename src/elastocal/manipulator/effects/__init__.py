"""The catalogue of effects.  A new effect is one file here and one line below."""

from __future__ import annotations

from elastocal.manipulator.effects.backlash import Backlash
from elastocal.manipulator.effects.base import Effect
from elastocal.manipulator.effects.base_compliance import BaseCompliance
from elastocal.manipulator.effects.base_drift import BaseDrift
from elastocal.manipulator.effects.base_frame import BaseFrame
from elastocal.manipulator.effects.distance_sensor import DistanceSensor
from elastocal.manipulator.effects.encoder_jump import EncoderJump
from elastocal.manipulator.effects.encoder_scale import EncoderScale
from elastocal.manipulator.effects.frame_jump import FrameJump
from elastocal.manipulator.effects.gear_eccentricity import GearEccentricity
from elastocal.manipulator.effects.gear_ripple import GearRipple
from elastocal.manipulator.effects.gear_second_harmonic import GearSecondHarmonic
from elastocal.manipulator.effects.gravity_compensator import GravityCompensator
from elastocal.manipulator.effects.hysteresis import Hysteresis
from elastocal.manipulator.effects.joint_compliance import JointCompliance
from elastocal.manipulator.effects.joint_drift import JointDrift
from elastocal.manipulator.effects.joint_hardening import JointHardening
from elastocal.manipulator.effects.joint_offset import JointOffset
from elastocal.manipulator.effects.link_bending import LinkBending
from elastocal.manipulator.effects.link_geometry import LinkGeometry
from elastocal.manipulator.effects.link_gravity import LinkGravity
from elastocal.manipulator.effects.link_mass_error import LinkMassError
from elastocal.manipulator.effects.marker_orientation import MarkerOrientation
from elastocal.manipulator.effects.marker_position import MarkerPosition
from elastocal.manipulator.effects.marker_slip import MarkerSlip
from elastocal.manipulator.effects.off_axis_compliance import OffAxisCompliance
from elastocal.manipulator.effects.payload import Payload
from elastocal.manipulator.effects.payload_error import PayloadError
from elastocal.manipulator.effects.thermal_expansion import ThermalExpansion
from elastocal.manipulator.effects.tracker_distortion import TrackerDistortion
from elastocal.manipulator.effects.wrist_coupling import WristCoupling

# Hooks run in this order: what sets a frame or a marker stands before what moves it.
CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        BaseFrame(),
        JointOffset(),
        EncoderScale(),
        GearEccentricity(),
        GearSecondHarmonic(),
        GearRipple(),
        WristCoupling(),
        JointDrift(),
        EncoderJump(),
        LinkGeometry(),
        ThermalExpansion(),
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
