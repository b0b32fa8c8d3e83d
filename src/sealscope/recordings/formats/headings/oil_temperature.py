"""The oil's temperature that a file states beside its samples."""

from __future__ import annotations

import re
from collections.abc import Mapping

from sealscope.recordings.formats.headings.preamble import remarks_of

_TEMPERATURE = re.compile(
    r"(?P<value>[-+]?\d{1,3}(?:[.,]\d{1,3})?)\s*(?P<unit>°\s?[CF]|deg\s?[CF]|[CFK]\b|℃)", re.IGNORECASE
)
_UNIT_OF_NAME = re.compile(r"[\[(]\s*([^\])]{1,6}?)\s*[\])]")
_OIL = re.compile(r"temp|oil|öl|oel|fluid|huile|olio|aceite", re.IGNORECASE)


def stated_oil_temperature(provenance: Mapping[str, object]) -> float | None:
    """Return the oil's temperature [deg C] by a recording's provenance, None where it does not state it."""
    for name, text in remarks_of(provenance).items():
        if not _OIL.search(name):
            continue
        unit_of_name = _UNIT_OF_NAME.search(name)
        match = _TEMPERATURE.search(text if unit_of_name is None else f"{text} {unit_of_name[1]}")
        if match is None:
            continue
        value, unit = float(match["value"].replace(",", ".")), match["unit"].upper().replace("℃", "C")[-1]
        celsius = (value - 32.0) / 1.8 if unit == "F" else value - 273.15 if unit == "K" else value
        if -60.0 < celsius < 200.0:
            return celsius
    return None
