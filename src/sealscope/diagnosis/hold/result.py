"""The result of a hold test, and the trace that its page draws."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from sealscope.diagnosis.hold.limits import Result
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Array
from sealscope.storage.plain_values import to_plain


@dataclass(frozen=True, eq=False)
class HoldCurve:
    """Trace of a hold with its fit, for a chart.

    Attributes
    ----------
    channel, unit : str
        What was read, such as "x" in "mm".
    t, values : ndarray
        Times since the recording's start [s] and readings (m,).
    fit, low, high : ndarray
        The fit at these times, and its 95 % interval.
    """

    channel: str
    unit: str
    t: Array
    values: Array
    fit: Array
    low: Array
    high: Array


@dataclass(frozen=True, kw_only=True)
class HoldResult:
    """Result of a hold test; intervals are of 95 %, and None stands for what the data do not tell.

    Parameters
    ----------
    file : str
        Name of the recording.
    start_s, end_s : float or None
        Times of the hold.
    creep_mm_per_min, creep_interval_mm_per_min : float or None, tuple or None
        Mean speed over the hold at which the piston sinks, positive towards the loaded chamber, without what settles
        when valves shut. A travel due to a temperature that is logged or stated is left out, one of oil that nobody
        logs is not.
    leak_lpm, leak_interval_lpm : float or None, tuple or None
        Mean flow out of the loaded chamber over the hold [L/min], corrected for compression and temperature, as it
        changes with pressure and viscosity; that of a tight cylinder is a hypothesis of its own (`[tight]` of
        `priors.toml`).
    pressure_bar : float or None
        Mean pressure of the loaded chamber.
    leak_at_lpm, leak_at_interval_lpm, at_bar : float or None, tuple or None, float or None
        The leak at a reference pressure, by laws between laminar flow and an orifice.
    result : {"pass", "fail", "undecided"} or None
        Result against the limit by ISO 14253-1; None without a limit.
    limit : str or None
        The limit as it was stated.
    causes : tuple of str
        What may leak or, if no leak is shown, "cooling" if it explains the creep.
    second_test : str
        Test that separates the causes; "" if there is nothing to separate.
    minutes_needed : float or None
        Minutes to hold in addition, after which the test is expected to decide.
    reason : str
        The result in a sentence.
    start : str or None
        Date and time of the recording, if its file states them.
    areas_mm2 : tuple of float
        Stated areas of the sides A and B.
    oil : str
        What was known of the oil's temperature.
    quality : tuple of Finding
        Findings on the data.
    curve : HoldCurve or None
        Trace and fit for a chart.

    Examples
    --------
    >>> import sealscope as ss
    >>> (result,) = ss.hold_test(collected="12 mL in 10 min", limit="ISO 10100: 0.3 mL/min")
    >>> result.result, round(1e3 * result.leak_lpm, 1), result.causes
    ('fail', 1.2, ('piston',))
    """

    file: str
    start_s: float | None = None
    end_s: float | None = None
    creep_mm_per_min: float | None = None
    creep_interval_mm_per_min: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    pressure_bar: float | None = None
    leak_at_lpm: float | None = None
    leak_at_interval_lpm: tuple[float, float] | None = None
    at_bar: float | None = None
    result: Result | None = None
    limit: str | None = None
    causes: tuple[str, ...] = ()
    second_test: str = ""
    minutes_needed: float | None = None
    reason: str = ""
    start: str | None = None
    areas_mm2: tuple[float, ...] = ()
    oil: str = ""
    quality: tuple[Finding, ...] = ()
    curve: HoldCurve | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values for JSON, without the curve; None for a number that is not finite."""
        plain = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "curve"}
        names = ("code", "channel", "count", "first_t", "severity", "text")
        plain["quality"] = [{name: getattr(finding, name) for name in names} for finding in self.quality]
        return to_plain(plain)  # type: ignore[no-any-return]
