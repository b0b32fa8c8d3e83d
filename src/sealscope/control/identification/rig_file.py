"""A rig's file from an identification: each value with its interval as its source."""

from __future__ import annotations

from sealscope.control.identification.identify import Identification
from sealscope.parameters.fields import leaves, unit_of
from sealscope.parameters.rig import Rig


def identified_rig_text(found: Identification, name: str, extends: str, files: int) -> str:
    """Return the text of a rig's file that extends another with what was identified from `files` recordings."""
    units = {dotted: unit_of(field) for dotted, field in leaves(Rig)}
    lines = [
        "# Written by `sealscope identify`. What is not stated here is that of the rig that it extends.",
        "",
        "[rig]",
    ]
    lines += [f'name = "{name}"', f'title = "identified from {files} recordings"', f'extends = "{extends}"', ""]
    parts: dict[str, list[str]] = {}
    for estimate in found.estimates:
        part, _, symbol = estimate.name.partition(".")
        low, high = estimate.interval
        value = max(estimate.value, 0.0) if estimate.name == "pump.G_pump" else estimate.value
        source = f"identified from {files} recordings: {low:.6g} to {high:.6g} {units[estimate.name]} (95 %)"
        parts.setdefault(part, []).append(
            f'{symbol} = {{ value = {value:.8g}, unit = "{units[estimate.name]}", source = "{source}" }}'
        )
    for part, rows in parts.items():
        lines += [f"[{part}]", *rows, ""]
    for what, why in found.untold:
        lines.append(f"# not told: {what}: {why}")
    return "\n".join(lines) + "\n"
