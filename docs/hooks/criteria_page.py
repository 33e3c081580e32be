"""The planning criteria as a page: each criterion's own name, unit, needs, bound and docstring."""

from __future__ import annotations

import inspect

from elastocal.planning.criteria import CRITERIA, ScenarioCriterion

HEAD = """# Criteria

What a measurement plan is judged by: `[design] criterion = "NAME"` in the cell file, or
`elastocal design --criterion NAME`. What the figures mean stands under
[Measurement plans](../measurement-plans.md), how to add one under
[Add a criterion](../adding-a-criterion.md).

This page is made from the code when the site is built: the texts are the criteria's own. Each is a
function Φ of the information matrix M of a plan, made as small as possible; V = M⁻¹ is the
covariance of the scaled parameters. Where it has a bound, the plan comes with a certificate.
"""
NEEDS = {
    "test_poses": "test poses (20 are drawn where the cell states none)",
    "combination": "`[design] combination`",
}


def page() -> str:
    """The page: a table of all criteria, then a section for each."""
    lines = ["| name | | figure | better | bound |", "|---|---|---|---|---|"]
    lines += [_row(criterion) for criterion in CRITERIA.values()]
    return "\n".join([HEAD, *lines, "", *(_section(c) for c in CRITERIA.values())])


def _row(criterion: type[ScenarioCriterion]) -> str:
    bound = "yes" if criterion.certifiable else "no"
    name = f"[`{criterion.name}`](#{criterion.name})"
    figure = criterion.unit or "–"
    return f"| {name} | {criterion.title} | {figure} | {criterion.better} | {bound} |"


def _section(criterion: type[ScenarioCriterion]) -> str:
    needs = ", ".join(NEEDS[need] for need in criterion.needs)
    parts = [
        f"## `{criterion.name}` {{#{criterion.name}}}\n",
        inspect.cleandoc(criterion.__doc__ or ""),
        "",
        *([f"- **Needs**: {needs}"] if needs else []),
        *([] if criterion.certifiable else [f"- **No bound**: it {criterion.without_bound}."]),
        "",
    ]
    return "\n".join(parts)
