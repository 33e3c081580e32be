"""What the name of a point or pose says: configuration, marker, repeat, load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.errors import InputError
from elastocal.importing.patterns import compiled
from elastocal.importing.records import Records
from elastocal.importing.schema import NamesTable
from elastocal.text import is_label, listed, quoted

GROUPS = ("configuration", "marker", "repeat", "load")
ADVICE = "write pattern in [source.names]"


def with_labels(where: str, records: Records, names: NamesTable | None) -> Records:
    """The records with `labels` from their columns, and from their names where a pattern is given.

    A group that a column gives too is taken from the column.  A name that no pattern matches is
    an error, or with unmatched = "ignore" passed over and listed.
    Raises InputError for patterns that are no regular expressions or have none of the groups, and
    for labels that no table can hold.
    """
    names = names or NamesTable()
    labels = {stem: records.texts[stem] for stem in GROUPS if stem in records.texts}
    named = records.texts.get("name")
    if names.pattern is not None and named is not None:
        found, bad = _parsed(where, records, names, named)
        if bad:
            keep = np.setdiff1d(np.arange(len(records)), bad)
            reasons = tuple(
                (int(records.line[i]), f"{quoted(named[i])} matches no pattern") for i in bad
            )
            records = _taken(records, keep, reasons)
            labels = {stem: [texts[i] for i in keep] for stem, texts in labels.items()}
            found = {stem: [texts[i] for i in keep] for stem, texts in found.items()}
        labels = found | labels
    if names.markers and "marker" in labels:
        labels["marker"] = [names.markers.get(m, m) for m in labels["marker"]]
    if names.in_order and "marker" not in labels:
        n = len(names.in_order)
        labels["marker"] = [names.in_order[i % n] for i in range(len(records))]
        if len(records) % n:
            raise InputError(
                f"{records.source}: {len(records)} points, which is no multiple of the {n} markers "
                f"{listed(names.in_order)} of in_order; a point is missing or one too many: name "
                "the points"
            )
    for stem, texts in labels.items():
        for i, text in enumerate(texts):
            if not is_label(text):
                raise InputError(
                    f"{records.where(i)}: {stem} {quoted(text)} cannot stand in a table; correct "
                    f"the name, or {ADVICE}"
                )
    return replace(records, labels=labels)


def _parsed(
    where: str, records: Records, names: NamesTable, named: list[str]
) -> tuple[dict[str, list[str]], list[int]]:
    patterns = [names.pattern] if isinstance(names.pattern, str) else list(names.pattern or ())
    expressions = [compiled(where, "pattern", text) for text in patterns]
    for expression in expressions:
        if not set(expression.groupindex) & set(GROUPS):
            raise InputError(
                f"{where}: pattern = {quoted(expression.pattern)} has none of the groups "
                f"{listed(f'(?P<{g}>…)' for g in GROUPS)}; name the parts of the name so"
            )
    found: dict[str, list[str]] = {stem: [] for stem in GROUPS}
    bad: list[int] = []
    for i, name in enumerate(named):
        match = next((m for e in expressions if (m := e.search(name))), None)
        if match is None:
            bad.append(i)
        groups = match.groupdict() if match else {}
        for stem in GROUPS:
            found[stem].append((groups.get(stem) or "").strip())
    if bad and (names.unmatched != "ignore" or len(bad) == len(named)):
        raise InputError(
            f"{records.where(bad[0])}: the name {quoted(named[bad[0]])} matches no pattern "
            f"({listed(map(quoted, patterns), 3)}), as do not {len(bad) - 1} others; {ADVICE}, or "
            'unmatched = "ignore" to leave such points out'
        )
    present = {stem: texts for stem, texts in found.items() if any(texts)}
    for stem, texts in present.items():
        empty = [i for i, text in enumerate(texts) if not text and i not in set(bad)]
        if empty and stem in ("configuration", "marker"):
            raise InputError(
                f"{records.where(empty[0])}: the name {quoted(named[empty[0]])} says no {stem}, "
                f"others do; {ADVICE} that finds it in every name"
            )
        if empty:
            default = "0" if stem == "repeat" else "none"
            present[stem] = [text or default for text in texts]
    return present, bad


def _taken(records: Records, keep: np.ndarray, reasons: tuple[tuple[int, str], ...]) -> Records:
    """The rows `keep`; the others are listed as passed over."""
    seen = records.understood
    ignored = tuple(sorted([*seen.ignored, *reasons]))
    return replace(
        records,
        line=records.line[keep],
        numbers={stem: values[keep] for stem, values in records.numbers.items()},
        texts={stem: [texts[i] for i in keep] for stem, texts in records.texts.items()},
        time=None if records.time is None else records.time[keep],
        understood=replace(seen, rows=len(keep), ignored=ignored),
    )
