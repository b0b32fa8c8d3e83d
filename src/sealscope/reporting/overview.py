"""A recording in a few lines of a terminal: where it comes from, its channels as small curves, and what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sealscope.paragraphs import WIDTH, paragraph
from sealscope.recordings.channels import LONG_NAMES, Array
from sealscope.recordings.formats.headings.preamble import remarks_of
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.reporting.charts import shown_values

_BARS = "▁▂▃▄▅▆▇█"
#: Width of a curve in characters.
CURVE = 20


def curve(values: Array, width: int = CURVE) -> str:
    """Draw values (n,) as `width` bars between their least and largest, blank for missing samples."""
    known = values[np.isfinite(values)]
    if not known.size:
        return " " * width
    low, high = float(known.min()), float(known.max())
    edges = np.linspace(0, values.size, min(width, values.size) + 1).astype(int)
    bars = []
    for begin, end in pairwise(edges):
        part = values[begin:end]
        part = part[np.isfinite(part)]
        if not part.size:
            bars.append(" ")
            continue
        # a middle sample, not a mean: a mean over many strokes would show a line
        share = (float(part[part.size // 2]) - low) / (high - low) if high > low else 0.0
        bars.append(_BARS[min(int(share * len(_BARS)), len(_BARS) - 1)])
    return "".join(bars)


def _short(value: float) -> str:
    """Format a number with four digits, without an exponent where it is large."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def overview_text(name: str, recording: Recording, findings: Sequence[Finding]) -> str:
    """Format a recording for inspection before a verdict: clock, channels with range and curve, notes, findings."""
    provenance = recording.provenance
    start = f", from {provenance['start']}" if "start" in provenance else ""
    kind = f"{provenance['format']}; " if "format" in provenance else ""
    seconds = len(recording) / recording.rate
    lines = [
        paragraph(f"{name}: {kind}{len(recording)} samples at {recording.rate:g} Hz, {seconds:g} s{start}", indent=2)
    ]
    for channel, values in recording.channels.items():
        unit, values_shown = shown_values(recording, channel, recording.pressure_unit)
        known = values_shown[np.isfinite(values_shown)]
        ends = f"{_short(known.min())} to {_short(known.max())} {unit}" if known.size else "no values"
        line = f"  {channel:<7}{LONG_NAMES[channel]:<24}{ends:<28}"
        lines.append(line + curve(values, max(CURVE // 2, WIDTH - len(line))))
    texts = [f"{name}: {value}" for name, value in remarks_of(provenance).items()]
    texts += [f"not used: {', '.join(recording.unused)}"] if recording.unused else []
    texts += [f"note: {line}" for line in recording.history]
    texts += [f"{finding.severity}: {finding.text}" for finding in findings] or ["no defect of the data"]
    return "\n".join((*lines, *(paragraph(text, "  ", 4) for text in texts)))
