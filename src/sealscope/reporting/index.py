"""Write the index of a folder of pages, with the verdict and action of each recording, the most severe first."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.paragraphs import format_count
from sealscope.reporting import messages, template

#: Order of the verdicts in an index.
_ORDER = ("leak", "cannot tell", "no leak")


def severity_key(diagnosis: Diagnosis) -> tuple[int, float, float, str]:
    """Compute a key that sorts diagnoses by severity, the most severe first.

    It is the verdict, then the leak over the repair limit, the leak or else the total leakage, and the file's name.
    """
    severity = diagnosis.severity
    limit_ratio = 0.0 if severity is None or severity.of_limit is None else severity.of_limit[0]  # [0]: no interval
    total_lpm = None if diagnosis.total_leakage is None else diagnosis.total_leakage.lpm
    lpm = total_lpm if diagnosis.leak_lpm is None else diagnosis.leak_lpm
    return (_ORDER.index(diagnosis.verdict), -limit_ratio, -(lpm or 0.0), diagnosis.file)


def write_index(path: str | os.PathLike[str], pages: Sequence[tuple[Path, Diagnosis]]) -> Path:
    """Write the index page of a folder of `pages` (path, diagnosis), the most severe first; return the path."""
    ordered_pages = sorted(pages, key=lambda page: severity_key(page[1]))
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
        for page, diagnosis in ordered_pages
    ]
    title = f"{format_count(len(pages), 'recording')}: {summary}"
    return template.write(path, template.render("index.html.j2", title=title, rows=rows))
