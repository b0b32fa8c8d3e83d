"""Format an overview of a recording for the terminal: origin, channels as small curves, notes and findings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sealscope.paragraphs import WIDTH, paragraph
from sealscope.recordings.channels import LONG_NAMES, Array, finite_range
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.reporting.charts import display_values

_BARS = "▁▂▃▄▅▆▇█"
#: Smallest width of a curve in characters.
_MIN_CURVE_WIDTH = 10


def draw_curve(values: Array, width: int) -> str:
    """Draw values (n,) as a line of at most `width` bar characters, scaled between minimum and maximum.

    Each character shows the middle one of the finite values in its part of the curve, or is blank if there are none.
    """
    if (ends := finite_range(values)) is None:
        return " " * width
    low, high = ends
    edges = np.linspace(0, values.size, min(width, values.size) + 1).astype(int)
    bars = []
    for begin, end in pairwise(edges):
        part = values[begin:end]
        part = part[np.isfinite(part)]
        if not part.size:
            bars.append(" ")
            continue
        # middle sample instead of mean: the mean over many strokes is constant
        fraction = (float(part[part.size // 2]) - low) / (high - low) if high > low else 0.0
        bars.append(_BARS[min(int(fraction * len(_BARS)), len(_BARS) - 1)])  # fraction 1 is the highest bar, too
    return "".join(bars)


def _format_short(value: float) -> str:
    """Format a number with four significant digits; from 1e4 to 1e9 as an integer instead of with an exponent."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def overview_text(name: str, recording: Recording, findings: Sequence[Finding]) -> str:
    """Format an overview of the recording in the file `name`: length, channels with small curves, notes, findings."""
    provenance = recording.provenance
    start = f", from {provenance['start']}" if "start" in provenance else ""
    kind = f"{provenance['format']}; " if "format" in provenance else ""
    clock = f"{len(recording)} samples at {recording.rate:g} Hz, {recording.duration:.7g} s{start}"
    lines = [paragraph(f"{name}: {kind}{clock}", indent=2)]
    for channel, values in recording.channels.items():
        ends = finite_range(values)
        unit, shown_ends = display_values(recording, channel, recording.pressure_unit, np.array(ends or (np.nan,)))
        text = f"{_format_short(shown_ends.min())} to {_format_short(shown_ends.max())} {unit}" if ends else "no values"
        line = f"  {channel:<7}{LONG_NAMES[channel]:<24}{text:<28}"
        width = max(_MIN_CURVE_WIDTH, WIDTH - len(line))  # the rest of the line
        lines.append(line + draw_curve(values, width))
    texts = [f"{name}: {value}" for name, value in recording.remarks.items()]
    texts += [f"not used: {', '.join(recording.unused)}"] if recording.unused else []
    texts += [f"note: {line}" for line in recording.history]
    texts += [f"{finding.severity}: {finding.text}" for finding in findings] or ["no defect of the data"]
    return "\n".join((*lines, *(paragraph(text, head="  ", indent=4) for text in texts)))
