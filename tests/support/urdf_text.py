"""Small URDFs as text: links, joints, and a plain arm to put mistakes into."""

from __future__ import annotations

LIMIT = '<limit lower="-1" upper="2" effort="1" velocity="1"/>'


def link(name: str, mass: float | str | None = None, com: str = "0 0 0") -> str:
    if mass is None:
        return f'<link name="{name}"/>'
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/></inertial>'
        '<visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual></link>'
    )


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 1"/>{inside}</joint>'
    )


def arm(n: int = 4, extra: str = "", replace: dict[str, str] | None = None) -> str:
    """l0 … ln joined by q1 … qn, plus `extra`, with literal replacements."""
    parts = [link(f"l{i}") for i in range(n + 1)]
    parts += [joint(f"q{i}", f"l{i - 1}", f"l{i}") for i in range(1, n + 1)]
    text = '<robot name="arm">' + "".join(parts) + extra + "</robot>"
    for old, new in (replace or {}).items():
        assert old in text
        text = text.replace(old, new, 1)
    return text
