"""The results on disk: a folder of Parquet parts, written by one process, checked on reading."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError, require
from elastocal.files import atomic_write_text
from elastocal.studies.table import arrow

if TYPE_CHECKING:
    import pandas
    import pyarrow

# Names with a leading underscore or dot are no parts to those who read the folder as a dataset.
STATEMENT, FAILURES, LOCK = "_study.json", "_failures.log", ".lock"


class Dataset:
    """Parts of a study's results; use it in `with opened(folder)`, which locks the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def parts(self) -> list[Path]:
        return sorted(self.folder.glob("part-*.parquet"))

    def next_number(self) -> int:
        return max((int(p.stem.partition("-")[2]) for p in self.parts()), default=0) + 1

    def write(self, number: int, table: pyarrow.Table) -> None:
        """Write part `number` (again), whole or not at all."""
        path = self.folder / f"part-{number:06d}.parquet"
        temporary = self.folder / f".{path.name}.tmp"
        try:
            with open(temporary, "wb") as handle:
                arrow().parquet.write_table(table, handle, compression="zstd")
                handle.flush()
                os.fsync(handle.fileno())
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise

    def read(self, schema: pyarrow.Schema | None = None) -> pyarrow.Table | None:
        """All lines, or None where there is no part yet.

        Raises InputError where a part is damaged, has other columns than `schema` (or than the
        first part), or two lines are the same row of the same task.
        """
        pa = arrow()
        tables = []
        for path in self.parts():
            try:
                table = pa.parquet.ParquetFile(path).read()
            except (pa.ArrowException, OSError) as error:
                raise InputError(
                    f"{path}: damaged Parquet file ({error}); delete it, and its tasks run again"
                ) from None
            schema = table.schema if schema is None else schema
            require(
                table.schema.equals(schema, check_metadata=True),
                f"{path}: has other columns, types or units than the study now; "
                "run with --restart, or with -o NEW",
            )
            tables.append(table)
        if not tables:
            return None
        whole = pa.concat_tables(tables)
        self._check_once(whole)
        return whole

    def _check_once(self, whole: pyarrow.Table) -> None:
        frame = whole.select(["task", "task_hash", "task_row"]).to_pandas()
        twice = frame.duplicated(["task", "task_row"])
        hashes = frame.groupby("task")["task_hash"].nunique()
        alone = frame["task_row"].isna() & frame["task"].duplicated(keep=False)
        wrong = set(frame.loc[twice | alone, "task"]) | set(hashes.index[hashes > 1])
        require(
            not wrong,
            f"{self.folder}: task {min(wrong, default=0)} has more than one result; parts of two "
            "runs were put together: remove those of one, or run with --restart",
        )

    def drop_failed(self) -> int:
        """Remove the lines of failed tasks, part by part; their number."""
        pa = arrow()
        import pyarrow.compute as pc

        dropped = 0
        for path in self.parts():
            table = pa.parquet.ParquetFile(path).read()
            good = table.filter(pc.is_null(table["task_error"]))
            if good.num_rows == table.num_rows:
                continue
            dropped += table.num_rows - good.num_rows
            if good.num_rows:
                self.write(int(path.stem.partition("-")[2]), good)
            else:
                path.unlink()
        return dropped

    def clear(self) -> None:
        """Remove all results."""
        for path in [*self.parts(), self.folder / STATEMENT, self.folder / FAILURES]:
            path.unlink(missing_ok=True)

    def state(self, statement: Mapping[str, Any]) -> None:
        """Write down what the results are of: seed, options, hashes of the sources."""
        atomic_write_text(
            self.folder / STATEMENT,
            json.dumps(statement, indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        )

    def stated(self) -> dict[str, Any]:
        """What `state` wrote; empty where there is none."""
        try:
            found = json.loads((self.folder / STATEMENT).read_text("utf-8"))
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def log(self, text: str) -> None:
        """Append to the log of failures."""
        with open(self.folder / FAILURES, "a", encoding="utf-8") as handle:
            handle.write(text)


@contextmanager
def opened(folder: Path) -> Iterator[Dataset]:
    """The dataset in `folder`, made where absent, with no other process writing to it.

    Raises InputError where the folder cannot be made, holds something else, or another run has
    it.  What a killed run left half-written is removed.
    """
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
    dataset = Dataset(folder)
    foreign = [p.name for p in sorted(folder.iterdir()) if not p.name.startswith((".", "_"))]
    foreign = [n for n in foreign if not (n.startswith("part-") and n.endswith(".parquet"))]
    require(
        not foreign,
        f"{folder}: holds {', '.join(foreign[:3])}, which no study wrote; name a folder of its own",
    )
    with open(folder / LOCK, "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"{folder}: another run of the study is writing there; wait for it, or name "
                "another folder with -o"
            ) from None
        for left in folder.glob(".part-*.tmp"):
            left.unlink(missing_ok=True)
        yield dataset


def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """The rows of a study, sorted by task and row; failed tasks only where `failed`.

    Columns: task, task_hash, the task's values, task_row, the results, task_seconds,
    elastocal (version), task_error.
    Raises InputError where there are none, or a result is there twice.
    """
    whole = Dataset(Path(folder)).read()
    if whole is None:
        raise InputError(f"{folder}: holds no results; run elastocal study first")
    frame = whole.to_pandas()
    for field in whole.schema:
        if (field.metadata or {}).get(b"json"):
            frame[field.name] = frame[field.name].map(json.loads)
    wanted = frame["task_error"].notna() if failed else frame["task_row"].notna()
    frame = frame[wanted].sort_values(["task", "task_row"], ignore_index=True)
    return frame if failed else frame.astype({"task_row": "int64"})
