"""A world on disk: what the tool may see in one folder, the truth in another.

visible/  arm.urdf  cell.toml  data.csv
sealed/   truth.json  fresh.csv (the same columns; 100 other poses, no noise, no scatter)

    python experiment_design/blind_diagnosis/world_files.py

writes the campaign of the README's example, its truth beside it for once.
"""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from draw import Recipe, World
from skeleton import Array
from world import Effect, Visits

FITTED = ("base_frame", "joint_offset", "link_geometry", "joint_compliance", "marker_position")


def write_world(world: World, visible: Path, sealed: Path) -> None:
    """Both folders are made; they must not lie within each other."""
    visible, sealed = Path(visible).resolve(), Path(sealed).resolve()
    if visible.is_relative_to(sealed) or sealed.is_relative_to(visible):
        raise ValueError(f"{sealed} would hold the truth within the tool's reach: {visible}")
    for folder in (visible, sealed):
        folder.mkdir(parents=True, exist_ok=True)
    if world.told.weights:
        shutil.copyfile(world.spec.urdf, visible / "arm.urdf")
    else:
        (visible / "arm.urdf").write_text(without_weights(world.spec.urdf), encoding="utf-8")
    (visible / "cell.toml").write_text(cell_text(world), encoding="utf-8")
    write_table(world, world.visits, world.readings(), visible / "data.csv")
    fresh = world.fresh()
    write_table(world, fresh, world.noise_free(fresh), sealed / "fresh.csv")
    truth = json.dumps(truth_of(world), indent=2) + "\n"
    (sealed / "truth.json").write_text(truth, encoding="utf-8")


def without_weights(urdf: Path) -> str:
    """The arm's URDF with no mass in it."""
    root = ElementTree.parse(urdf).getroot()
    for link in root.iter("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    return ElementTree.tostring(root, encoding="unicode")


def cell_text(world: World) -> str:
    """The cell as its owner would write it: nominal data, nothing of the truth."""
    spec, specimen = world.spec, world.specimen
    markers = "\n".join(
        f"{name} = {list(p)}" for name, p in zip(spec.marker_names, spec.markers, strict=True)
    )
    orders = f"gear_ripple_orders = {world.orders.tolist()}\n" if world.orders.size else ""
    return f"""name = "simulated campaign"

[robot]
urdf = "arm.urdf"
base = "base_link"
flange = "flange"

[tool]
load_point_m = {list(spec.hook)}

[tool.markers_m]
{markers}

[tracker]
position_m = [0.0, 0.0, 0.0]

[model]
observe = "position"
link_gravity = {json.dumps(world.told.weights)}
effects = {json.dumps(FITTED)}
{orders}
[model.nominal]
base_position_m = {specimen.base_position.tolist()}
base_rpy_deg = [0.0, 0.0, {specimen.base_yaw_deg}]
joint_compliance = {specimen.compliance.tolist()}
"""


def write_table(world: World, visits: Visits, readings: Array, path: Path) -> None:
    """One row per visit and marker; the stated sigmas are the noise's own times its factor."""
    J = visits.q.shape[1]
    header = [
        "configuration", "repeat", "marker", *[f"q{j + 1}_rad" for j in range(J)],
        "force_x_N", "force_y_N", "force_z_N", "x_m", "y_m", "z_m",
        "sigma_range_um", "sigma_azimuth_um", "sigma_elevation_um",
    ]  # fmt: skip
    told = world.told
    header += ["time_min"] if told.time else []
    header += [f"approach_{j + 1}" for j in range(J)] if told.approach else []
    sigma = 1e6 * world.noise.stated * world.noise.sigma(readings)
    lines = [",".join(header)]
    for i, pose in enumerate(visits.pose):
        joints = [f"{v:.9f}" for v in visits.q[i]]
        force = [f"{v + 0.0:.3f}" for v in visits.force[i]]
        late = [f"{visits.time[i] / 60:.3f}"] if told.time else []
        late += [f"{int(a):d}" for a in visits.approach[i]] if told.approach else []
        for k, name in enumerate(world.spec.marker_names):
            observed = [f"{v:.9f}" for v in readings[i, k]] + [f"{v:.2f}" for v in sigma[i, k]]
            lines.append(",".join([str(pose), "0", name, *joints, *force, *observed, *late]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def truth_of(world: World) -> dict[str, object]:
    """Everything that is withheld, as JSON."""
    true, noise = world.specimen.true, world.noise
    return {
        "world": world.name,
        "seed": list(world.seed),
        "arm": world.spec.name,
        "effects": [_effect(e) for e in world.effects],
        "plan": {
            "poses": int(world.visits.pose.max()) + 1,
            "order": world.plan,
            "approach_by_motion": world.approach_by_motion,
            "told": vars(world.told),
        },
        "noise": {
            "variant": noise.variant,
            "level_um": 1e6 * noise.level,
            "stated_over_true": noise.stated,
            "repeatability_urad": (1e6 * noise.repeatability).tolist(),
            "outlier_share": noise.outlier_share,
        },
        "arm_values": {
            "joint_compliance": true.compliance.tolist(),
            "joint_offset_rad": true.offset.tolist(),
            "base_position_m": true.base_position.tolist(),
            "base_rotation": true.base_rotation.tolist(),
            "markers_m": true.markers.tolist(),
        },
    }


def _effect(e: Effect) -> dict[str, object]:
    told = {"effect": e.name, "where": e.where, "in_catalogue": not e.stage}
    told |= {"values": e.values, "settings": e.settings}
    place = {"location": {"stage": e.stage, "where": e.where, "driver": e.driver}}
    return told | (place if e.stage else {})


if __name__ == "__main__":
    HERE = Path(__file__).resolve().parent
    recipe = Recipe("example", (2026, 11), ("backlash",), arm="heavy", level=25e-6)
    write_world(recipe.draw(), HERE / "example", HERE / "example_truth")
