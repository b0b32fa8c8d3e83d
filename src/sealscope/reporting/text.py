"""The terminal text of a diagnosis."""

from __future__ import annotations

from textwrap import fill

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.reporting import messages


def _printable(text: str) -> str:
    """The text on one line, without control characters that a file name or header could bring to a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def _row(label: str, text: str, width: int) -> str:
    return fill(
        _printable(text), width, initial_indent=f"  {label:<10}", subsequent_indent=" " * 12, break_on_hyphens=False
    )


def diagnosis_text(diagnosis: Diagnosis, *, width: int = 100) -> str:
    """The verdict and the figures behind it as plain text of a few lines, the first being `FILE: verdict`.

    `width`: columns [1]. No colours: those are the caller's matter.
    """
    lines = [f"{_printable(diagnosis.file)}: {diagnosis.verdict}"]
    rows = [
        ("since", messages.since(diagnosis)),
        ("how much", messages.how_much(diagnosis)),
        ("cause", messages.cause(diagnosis)),
        ("how sure", messages.how_sure(diagnosis)),
        ("reason", diagnosis.reason or None),
    ]
    lines += [_row(label, text, width) for label, text in rows if text]
    for method in diagnosis.methods:
        figures = (
            f"{method.verdict} (score {messages.number(method.score)}, threshold {messages.number(method.threshold)})"
        )
        if method.score is None and method.reason:
            figures = f"{method.verdict} ({method.reason})"
        lines.append(_row("method", f"{method.detector}: {figures}", width))
    lines += [_row(finding.severity, finding.text, width) for finding in diagnosis.quality]
    lines += [_row("next" if i == 0 else "", step, width) for i, step in enumerate(messages.next_steps(diagnosis)[:2])]
    return "\n".join(lines)
