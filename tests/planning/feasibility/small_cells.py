"""Cells to test rules on: a KR 270-2 among bodies, and a gantry whose geometry is plain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.robots import KR270, random_chain_urdf

from elastocal.cell import Cell, Solid, Workspace
from elastocal.cell_tables import Robot, Tool, Tracker
from elastocal.model.chain import Chain, Joint
from elastocal.model.urdf import read_urdf
from elastocal.planning.feasibility import Feasibility, PoseFeasibility

CHECK = Path(__file__).resolve().parents[3] / "experiment_design" / "feasibility_check"
DOWN = np.array([0.0, 0.0, -2600.0])
NOTHING = np.zeros(3)
KR270_CHAIN = read_urdf(KR270)


def breaking(verdict: PoseFeasibility) -> dict[str, int]:
    return dict(zip(verdict.rules, verdict.broken.sum(axis=0).tolist(), strict=True))


def freed_by(verdict: PoseFeasibility) -> dict[str, int]:
    """Candidates that break this rule and no other: what dropping it would free."""
    return breaking(replace(verdict, broken=verdict.broken & (verdict.broken.sum(1) == 1)[:, None]))


def at(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def box(name: str, size: tuple[float, float, float], centre: tuple[float, float, float]) -> Solid:
    return Solid(name, "box", np.array(size), at(*centre))


def sphere(name: str, radius: float, centre: tuple[float, float, float]) -> Solid:
    return Solid(name, "sphere", np.array([radius]), at(*centre))


def gantry() -> Chain:
    """x, y, z slides and a turn about z; at q the flange stands at q[:3], its axes the data's."""
    axes = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))
    slides = [
        Joint(f"slide{i}", "prismatic", np.eye(4), np.array(axis), -3.0, 3.0)
        for i, axis in enumerate(axes)
    ]
    turn = Joint("turn", "revolute", np.eye(4), np.array([0, 0, 1.0]), -np.pi, np.pi)
    return Chain("gantry", (*slides, turn), np.eye(4))


def cell(workspace: Workspace, tool: Tool | None = None, tracker: Tracker | None = None) -> Cell:
    return Cell("test", None, Robot(), tool or Tool(), tracker or Tracker(), workspace=workspace)


def gantry_rules(
    workspace: Workspace, tool: Tool | None = None, tracker: Tracker | None = None
) -> Feasibility:
    return Feasibility(cell(workspace, tool, tracker), gantry())


def gantry_at(*positions: tuple[float, float, float]) -> np.ndarray:
    return np.hstack([np.array(positions, dtype=float), np.zeros((len(positions), 1))])


def broken(feasibility: Feasibility, q: np.ndarray, force: np.ndarray) -> list[set[str]]:
    verdict = feasibility.check(q, force)
    return [{r for r, hit in zip(verdict.rules, row, strict=True) if hit} for row in verdict.broken]


def random_chain(seed: int, folder: Path) -> Chain:
    path = folder / f"{seed}.urdf"
    path.write_text(random_chain_urdf(seed))
    return read_urdf(path, base="base", flange="flange")


def kr270_poses(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lower, upper = ([getattr(j, end) for j in KR270_CHAIN.joints] for end in ("lower", "upper"))
    return rng.uniform(lower, upper, (n, 6))
