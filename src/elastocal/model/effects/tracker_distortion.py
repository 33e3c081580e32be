"""What the instrument itself distorts: its scale, the air, its angle encoders."""

from __future__ import annotations

import casadi as ca

from elastocal.cell.work_cell import Cell
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import MEASURE_SCALE, Effect, Symbols

ENCODERS = ("azimuth_sin", "azimuth_cos", "elevation_sin", "elevation_cos")


class TrackerDistortion(Effect):
    """Range, refraction and angle-encoder errors of a polar instrument at `[tracker] position_m`.

    With azimuth A, elevation E, range r and horizontal range s of the marker:
    A ← A + azimuth_sin·sin A + azimuth_cos·cos A, E likewise, r ← (1 + scale) r, then
    z ← z + refraction·s².  Eccentric circles shift an encoder's reading once per turn (rad); a
    wrong wavelength, air temperature or pressure scales the range (1); a vertical gradient of
    the air's temperature bends the beam, 1/m (half its curvature, 1 K/m makes 5e-7).  z is
    vertical.  Source: Muralikrishnan et al. 2009, "ASME B89.4.19 performance evaluation tests and
    geometric misalignments in laser trackers"; Hughes et al. 2011, "Laser tracker error
    determination using a network measurement".
    Distances of a wire or ball-bar have no such errors, hence no place.
    """

    name = "tracker_distortion"
    stage = "tracker"
    remedy = MEASURE_SCALE
    # Data sheets promise 12 µrad and 5 ppm; an instrument that is out by ten times the typical size
    # is one to be mended, and what is out by more is no instrument's error.
    most = 10.0
    unknowns = (
        ParameterSpec("scale", "1", 0.0, 2e-5),
        ParameterSpec("refraction", "1/m", 0.0, 1e-6),
        *(ParameterSpec(key, "rad", 0.0, 2e-5) for key in ENCODERS),
    )

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return () if cell.model.observe == "distance" else ("tracker",)

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return (*self.needs, *["station"] * (not cell.tracker.position.any()))

    def read(self, arm: Arm, place: str, p: Symbols) -> None:
        station = rigid.constant(arm.cell.tracker.position)
        x, y, z = ca.vertsplit(ca.densify(arm.reading["position"] - station))
        # Angles enter by their sines and cosines alone, so that no direction is special.
        horizontal = ca.sqrt(x**2 + y**2 + rigid.TINY)
        slant = ca.sqrt(x**2 + y**2 + z**2 + rigid.TINY)
        azimuth = (p["azimuth_sin"] * y + p["azimuth_cos"] * x) / horizontal
        elevation = (p["elevation_sin"] * z + p["elevation_cos"] * horizontal) / slant
        x, y = _turned(x, y, azimuth)
        outward, z = _turned(horizontal, z, elevation)
        x, y = x * outward / horizontal, y * outward / horizontal
        observed = (1 + p["scale"]) * ca.vertcat(x, y, z)
        sag = p["refraction"] * ca.sumsqr(observed[:2])
        arm.reading["position"] = station + observed + ca.vertcat(0, 0, sag)


def _turned(a: ca.SX, b: ca.SX, angle: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(a, b) turned by `angle` in their plane."""
    c, s = ca.cos(angle), ca.sin(angle)
    return c * a - s * b, s * a + c * b
