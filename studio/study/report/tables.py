"""The rows of a study as CSV and Parquet; and back, so that documents can be checked without the runs."""

import dataclasses
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from morph_core.run_folder import STUDY
from studio.study.plan import read_study
from studio.study.report.results import CurveRow, DesignRow, Results, RunRow, SettingRow

if TYPE_CHECKING:
    import pyarrow

TABLES: dict[str, type] = {"runs": RunRow, "curves": CurveRow, "phi": DesignRow, "settings": SettingRow}
"""File name of each table, and the class of its rows."""


def write_tables(results: Results, folder: Path) -> None:
    """Write the plan, and runs, curves, phi and settings each as CSV and as Parquet."""
    import pyarrow.csv
    import pyarrow.parquet

    folder.mkdir(parents=True, exist_ok=True)
    (folder / STUDY).write_bytes(msgspec.json.format(msgspec.json.encode(results.study), indent=2))
    every = (results.runs, results.curves, results.designs, results.settings)
    for (name, kind), rows in zip(TABLES.items(), every, strict=True):
        table = table_of(kind, rows)
        pyarrow.csv.write_csv(table, folder / f"{name}.csv")
        pyarrow.parquet.write_table(table, folder / f"{name}.parquet", compression="zstd")


def read_tables(folder: Path) -> Results:
    """Return what a report's folder says of its study; a table that is not there is empty."""
    study = read_study(folder)
    rows = {name: _rows_of(kind, folder / f"{name}.csv") for name, kind in TABLES.items()}
    return Results(study, rows["runs"], rows["curves"], rows["phi"], rows["settings"])


def _rows_of(kind: type, path: Path) -> list[Any]:
    import pyarrow.csv

    if not path.is_file():
        return []
    options = pyarrow.csv.ConvertOptions(
        column_types=_schema(kind), strings_can_be_null=True, quoted_strings_can_be_null=False
    )
    return [kind(**row) for row in pyarrow.csv.read_csv(path, convert_options=options).to_pylist()]


def table_of(kind: type, rows: Sequence[Any]) -> "pyarrow.Table":
    """Return rows as a table whose columns and their kinds are those of the class, also without any row."""
    import pyarrow

    return pyarrow.Table.from_pylist([dataclasses.asdict(row) for row in rows], _schema(kind))


def _schema(kind: type) -> "pyarrow.Schema":
    import pyarrow

    arrow = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64(), bool: pyarrow.bool_()}
    hints = typing.get_type_hints(kind)
    return pyarrow.schema([(field.name, arrow[_bare(hints[field.name])]) for field in dataclasses.fields(kind)])


def _bare(annotation: Any) -> type:
    """Return the type of an annotation that may allow None."""
    if isinstance(annotation, types.UnionType):
        (annotation,) = (kind for kind in typing.get_args(annotation) if kind is not types.NoneType)
    return annotation
