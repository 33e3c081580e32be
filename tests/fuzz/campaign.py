"""Small valid input for every verb: the commands of the goldens, and the files that they read."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import typer
from golden import runner
from golden.door import equal_noise
from golden.goldens import ARM, CAMPAIGN, GOLDENS

from elastocal.__main__ import commands

VERBS = tuple(typer.main.get_command(commands()).commands)
IGNORED = shutil.ignore_patterns("__pycache__")
# The options that name a file to write.
WRITES = ("-o", "--report", "--certificate", "--residuals", "--truth", "--plan", "--cell-out",
          "--table", "--joint-correction", "--picture", "--program")  # fmt: skip


@dataclass(frozen=True)
class Command:
    """A verb with valid arguments."""

    line: str

    @property
    def verb(self) -> str:
        return self.line.split()[0]

    @property
    def words(self) -> list[str]:
        return shlex.split(self.line)[1:]

    @property
    def outputs(self) -> list[tuple[str, str]]:
        """Options that name a file to write, folders left out, with that name."""
        return [(o, name) for o, name in pairwise(self.words) if o in WRITES and "." in name]

    def inputs(self, folder: Path) -> list[Path]:
        """Every file that it reads in `folder`; those last that another one names."""
        given = [folder / word for word in self.words if (folder / word).exists()]
        texts = "".join(path.read_text("utf-8") for path in given if path.suffix == ".toml")
        named = [path for path in sorted(folder.iterdir()) if f'"{path.name}"' in texts]
        below = [
            path for above in given if above.is_dir() for path in sorted(above.glob("study.*"))
        ]
        return [path for path in (*given, *named, *below) if path.is_file()]


ALL = tuple(
    Command(step)
    for golden in GOLDENS.values()
    for step in golden.steps
    if isinstance(step, str) and step.split()[0] in VERBS and "--help" not in step
)
# Those that read the small campaign as it is, or nothing, and do not fail by what they require.
COMMANDS = tuple(
    Command(step)
    for name, golden in GOLDENS.items()
    for step in golden.steps
    if isinstance(step, str)
    and golden.inputs in ((), CAMPAIGN, ARM)
    and name not in ("help", "identify_limits", "identify_smooth")
)


def write(folder: Path) -> None:
    """All files that COMMANDS read, in `folder`; the tables and results are the tool's own."""
    for (inputs,) in (CAMPAIGN, ARM):
        shutil.copytree(runner.ROOT / inputs, folder, ignore=IGNORED, dirs_exist_ok=True)
    equal_noise(folder)
