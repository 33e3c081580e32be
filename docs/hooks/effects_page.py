"""The catalogue of effects as a page: each effect's own docstring, parameters, places, columns."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace

from elastocal.cell import Cell, read_cell
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Effect, ParameterSpec, Setting
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import load_chain
from elastocal.report.blocks import display
from elastocal.simulation import DEMO

STAGES = {
    "transmission": "Transmission: what the gears make of the commanded joints",
    "geometry": "Geometry: where the links lead",
    "load": "Load: what pulls at the arm",
    "compliance": "Compliance: what gives way",
    "tool": "Tool: where the markers sit",
    "tracker": "Tracker: what the instrument reports",
}
COLUMNS = {
    "time": "`time_s` or `time_min`",
    "approach": "`approach_1 …`",
    "temperature": "`temperature_C`",
    "load": "`force_x_N …`",
    "torque": "`torque_1_Nm …`",
    "station": "a tracker outside the arm's reach, or `[tracker] position_m`",
}
OBSERVED = ("position", "deflection", "pose", "distance")
# Order of size where the parameters' own size is known only from the cell.
SHOWN = {"order_1": 36.5, "order_2": 101.0, "order_sd_2": 0.05, "field_joint2_size": 2e-4}
COMPLIANCE = (2e-6, 3e-7, 4e-7, 3e-6, 3.5e-6, 2e-6)  # rad/(N m)
HEAD = """# Effects

Everything that makes a real arm differ from its nominal chain is an *effect* on one link of the
chain. An effect is switched on in the cell file, everywhere it makes sense
(`effects = ["joint_offset"]`) or at one place (`effects = ["joint_offset:joint2"]`). `identify`
fits the parameters of the effects that are on; `diagnose` asks which of those that are off explains
the residual.

This page is made from the code when the site is built: the texts are the effects' own. Places,
nominal values and sizes are those of the KR 270 of the demo, with joint compliances of 0.3 to
3.5 µrad/(N·m). The *typical size* is the deviation from nominal that one expects: it scales
columns of B before any rank is judged, it is the prior of a diagnosis, and `simulate --draw 1`
draws from it. Parameters that are *shrunk* are many, and each has the prior N(nominal, typical²) in
every fit: what the readings do not show stays at nominal. Effects that consist of such parameters
correct the arm; they are shown here with two lines, or a field over one joint's angle.
"""


def page() -> str:
    """The page, a section for each stage of the chain and in it each effect of the catalogue."""
    base = read_cell(DEMO / "cell.toml")
    chain = load_chain(base)
    parts = [HEAD, _overview()]
    for stage, title in STAGES.items():
        parts.append(f"## {title}\n")
        parts += [_section(e, chain, base) for e in CATALOGUE.values() if e.stage == stage]
    return "\n".join(parts)


def _overview() -> str:
    lines = ["| stage | effects |", "|---|---|"]
    for stage in STAGES:
        names = [e.name for e in CATALOGUE.values() if e.stage == stage]
        lines.append(f"| {stage} | " + ", ".join(f"[`{n}`](#{n})" for n in names) + " |")
    return "\n".join(lines) + "\n"


def _section(effect: Effect, chain: Chain, base: Cell) -> str:
    cell = _observing("position", base)
    places = effect.places(chain, cell)
    parts = [
        f"### `{effect.name}` {{#{effect.name}}}\n",
        inspect.cleandoc(effect.__class__.__doc__ or ""),
        "",
        f"- **Places**: {_places(places)}",
        f"- **Columns that it needs**: {_columns(effect, chain, cell)}",
    ]
    without = [o for o in OBSERVED if not effect.places(chain, _observing(o, base))]
    if without:
        parts.append("- **Not with** `observe` = " + ", ".join(f"`{o}`" for o in without))
    if settings := effect.settings(places[0], chain, cell):
        parts.append(f"- **Settings** (set or searched, not fitted): {_settings(settings)}")
    parameters = effect.parameters(places[0], chain, cell)
    parts += ["", _parameters(places[0], parameters) if parameters else "No parameters.", ""]
    return "\n".join(parts)


def _observing(observe: str, base: Cell) -> Cell:
    """The demo's cell with another observation, and with all that gives effects their sizes."""
    chain = load_chain(base)
    places = {place for e in CATALOGUE.values() for place in e.places(chain, base)}
    model = replace(
        base.model,
        observe=observe,  # type: ignore[arg-type]
        compliance_levels={},
        gear_ripple_orders=(121.0,),
        nominal=replace(
            base.model.nominal, joint_compliance=COMPLIANCE, settings=dict.fromkeys(places, SHOWN)
        ),
    )
    return replace(base, model=model)


def _places(places: tuple[str, ...]) -> str:
    """Runs of numbered places in short: `joint1` … `joint6`."""
    shown: list[str] = []
    kinds = [re.sub(r"\d+$", "", p) for p in places]
    for kind in dict.fromkeys(kinds):
        same = [p for p, its in zip(places, kinds, strict=True) if its == kind]
        run = [f"{kind}{i + 1}" for i in range(len(same))]
        if len(same) > 2 and same == run:
            shown.append(f"`{same[0]}` … `{same[-1]}`")
        else:
            shown += [f"`{p}`" for p in same]
    return ", ".join(shown)


def _columns(effect: Effect, chain: Chain, cell: Cell) -> str:
    needed = effect.needed(cell)
    found = [COLUMNS[n] for n in needed]
    if effect.name == "thermal_expansion":
        found.append('(or `temperature_C` with `thermal_driver = "temperature"`)')
    if not found:
        loaded = effect.stage in ("load", "compliance") or effect.name == "backlash"
        return "joints; it shows under a load (`force_x_N …`)" if loaded else "joints alone"
    return ", ".join(found)


def _settings(settings: tuple[Setting, ...]) -> str:
    shown = []
    for s in settings:
        default = "no default" if s.default is None else f"default {s.default:g}"
        bounded = abs(s.lower) < float("inf") and abs(s.upper) < float("inf")
        ends = f", {s.lower:g} to {s.upper:.0f}" if bounded else ""
        shown.append(f"`{s.key}` ({default}{ends})")
    return ", ".join(shown)


def _parameters(place: str, parameters: tuple[ParameterSpec, ...]) -> str:
    lines = [
        "| parameter | unit | nominal | typical size | bounds |",
        "|---|---|---|---|---|",
    ]
    for family in _families(parameters):
        p = family[0]
        sizes = list(dict.fromkeys(_size(p) for p in family))
        ends = [min(family, key=_typical), max(family, key=_typical)]
        typical = " to ".join(_size(p) for p in ends) if len(sizes) > 1 else sizes[0]
        typical += ", shrunk" if p.shrunk else ""
        name = f"`{place}.{p.key}`"
        name += f" … `{place}.{family[-1].key}`" if len(family) > 1 else ""
        lower = "" if p.lower == float("-inf") else f"≥ {p.lower:g}"
        upper = "" if p.upper == float("inf") else f"≤ {p.upper:g}"
        bounds = " ".join(filter(None, (lower, upper))) or "–"
        unit = p.unit.replace("*", "·").replace("^3", "³")
        lines.append(f"| {name} | {unit} | {p.nominal:g} | {typical} | {bounds} |")
    return "\n".join(lines)


def _families(parameters: tuple[ParameterSpec, ...]) -> list[list[ParameterSpec]]:
    """Parameters that differ in their number only, many and shrunk, together; others alone."""
    families: dict[tuple[str, str], list[ParameterSpec]] = {}
    for p in parameters:
        kind = re.sub(r"\d+$", "", p.key) if p.shrunk else p.key
        families.setdefault((kind, p.unit), []).append(p)
    return list(families.values())


def _typical(p: ParameterSpec) -> float:
    return p.typical or 0.0


def _size(p: ParameterSpec) -> str:
    if p.typical is None:
        return "from the readings"
    value, shown = display(p.typical, p.unit)
    return f"{float(f'{value:.2g}'):g} {shown}"
