"""Rows of a long benchmark in a CSV file, so that a second call goes on; rows of other sources are dropped.

A source is a hash of the package's compiled sources and of the benchmark's script.
"""

from __future__ import annotations

import csv
import hashlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import sealscope as ss
from sealscope.compiled import source_hash


class StoredRows:
    """The rows of a file for the present source and the same settings."""

    def __init__(self, path: Path, columns: Sequence[str], **settings: object) -> None:
        self._path, self._columns = path, ("source", *settings, *columns)
        script = hashlib.sha256(Path(sys.argv[0]).read_bytes()).hexdigest()
        source = source_hash(Path(ss.__file__).parent)[:12] + script[:4]
        self._settings = {"source": source} | {name: str(value) for name, value in settings.items()}
        kept = [row for row in self._read() if row.get("source") == source] if path.exists() else []
        part = path.with_suffix(".part")
        with part.open("w", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            writer.writerows(kept)
        part.replace(path)

    def _writer(self, file: object) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self._columns, restval="", extrasaction="ignore", lineterminator="\n")  # type: ignore[arg-type]

    def _read(self) -> list[dict[str, str]]:
        with self._path.open(newline="") as file:
            return list(csv.DictReader(file))

    def select(self, **values: object) -> list[dict[str, str]]:
        """Return the rows with these values."""
        wanted = self._settings | {name: str(value) for name, value in values.items()}
        return [row for row in self._read() if all(row[name] == value for name, value in wanted.items())]

    def add(self, row: Mapping[str, object]) -> None:
        """Write a row, and print it."""
        with self._path.open("a", newline="") as file:
            self._writer(file).writerow({**row, **self._settings})
        print(dict(row), flush=True)
