"""The index of a folder of pages: one line a recording with what to do, the most severe first."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings.formats.columns import counted
from sealscope.reporting import messages, template

#: Verdicts as an index orders them.
_ORDER = ("leak", "cannot tell", "no leak")


def severity(diagnosis: Diagnosis) -> tuple[int, float, float, str]:
    """Return the sort key of a page: leaks by size, then `cannot tell`, then the total leakage."""
    leak_severity = diagnosis.severity
    size = 0.0 if leak_severity is None or leak_severity.of_limit is None else leak_severity.of_limit[0]
    flow = diagnosis.total_leakage.lpm if diagnosis.total_leakage is not None else None
    flow = flow if diagnosis.leak_lpm is None else diagnosis.leak_lpm
    return (_ORDER.index(diagnosis.verdict), -size, -(flow or 0.0), diagnosis.file)


def write_index(path: str | os.PathLike[str], pages: Sequence[tuple[Path, Diagnosis]]) -> Path:
    """Write the index of `pages`, each a page's path in the folder of `path` and its diagnosis."""
    ordered = sorted(pages, key=lambda page: severity(page[1]))
    counts = {verdict: sum(diagnosis.verdict == verdict for _, diagnosis in pages) for verdict in _ORDER}
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    rows = [
        {
            "href": quote(os.fsencode(page.name)),
            "file": Path(diagnosis.file).name,
            "symbol": diagnosis.state.symbol,
            "summary": diagnosis.summary,
            "since": messages.since(diagnosis),
            "how_much": messages.how_much(diagnosis) or messages.leakage_in_short(diagnosis),
            "cause": messages.cause(diagnosis) if diagnosis.verdict == "leak" else None,
            "action": messages.what_to_do(diagnosis),
        }
        for page, diagnosis in ordered
    ]
    return template.write(
        path, template.render("index.html.j2", title=f"{counted(len(pages), 'recording')}: {summary}", rows=rows)
    )
