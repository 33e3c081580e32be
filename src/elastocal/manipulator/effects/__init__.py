"""The catalogue of effects.  A new effect is one file here and one line below."""

from __future__ import annotations

from elastocal.manipulator.effects.base import Effect
from elastocal.manipulator.effects.base_compliance import BaseCompliance
from elastocal.manipulator.effects.base_frame import BaseFrame
from elastocal.manipulator.effects.distance_sensor import DistanceSensor
from elastocal.manipulator.effects.encoder_scale import EncoderScale
from elastocal.manipulator.effects.gravity_compensator import GravityCompensator
from elastocal.manipulator.effects.joint_compliance import JointCompliance
from elastocal.manipulator.effects.joint_offset import JointOffset
from elastocal.manipulator.effects.link_geometry import LinkGeometry
from elastocal.manipulator.effects.link_gravity import LinkGravity
from elastocal.manipulator.effects.marker_orientation import MarkerOrientation
from elastocal.manipulator.effects.marker_position import MarkerPosition
from elastocal.manipulator.effects.off_axis_compliance import OffAxisCompliance
from elastocal.manipulator.effects.payload import Payload

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        BaseFrame(),
        JointOffset(),
        EncoderScale(),
        LinkGeometry(),
        JointCompliance(),
        OffAxisCompliance(),
        BaseCompliance(),
        GravityCompensator(),
        LinkGravity(),
        Payload(),
        MarkerPosition(),
        MarkerOrientation(),
        DistanceSensor(),
    )
}
