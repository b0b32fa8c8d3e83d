"""The diagnosis of one recording: combined evidence of all detectors and its context, as in the output contract."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.verdict.evidence import AGAINST, LEAK, LEAKS, NO_LEAK, RMS_CHANGE, WITHIN, Evidence
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.diagnosis.verdict.severity import (
    LEAK_OVER_LIMIT,
    MachineState,
    RepairLimit,
    Severity,
    action_of,
    relative_leak,
    severity,
    state_of,
)
from sealscope.errors import InputError, MissingExtra
from sealscope.recordings.quality import MISSING_CHANNEL, Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_values import to_plain

if TYPE_CHECKING:
    import matplotlib.axes
    import pandas

#: Columns of a table of diagnoses, without those of the intervals.
_COLUMNS = (
    *("file", "start", "machine", "verdict", "reason", "onset_s", "leak_lpm", "bound_lpm", "score", "threshold"),
    *("chance", "odds", "false_alarm_probability", "cause", "summary", "next_check"),
)
#: Next check of a held load.
_NEXT_HOLD = "Judge it against a limit, and file the page: sealscope hold FILE --area AREA --limit '24 mm in 3 min'."
#: First fields of a diagnosis in JSON.
_FIRST_FIELDS = (
    *("file", "verdict", "reason", "onset_s", "onset_interval_s", "leak_lpm", "leak_interval_lpm", "bound_lpm"),
    *("unused", "false_alarm_probability", "score", "threshold"),
)
#: Smallest p-value of a usual test result.
_MIN_USUAL_CHANCE = 0.05
#: Names in a recording's preamble that state its machine, in the order of preference.
_MACHINE_NAMES = ("machine", "actuator", "asset", "serial number", "serial", "rig", "test rig", "maschine", "prüfstand")


@dataclass(frozen=True, kw_only=True)
class Diagnosis(Evidence):
    """Verdict on one recording: the combined evidence of all detectors.

    The fields of `Evidence` are those of the combined evidence. `parts` has the evidence of every detector, first that
    of the deciding detector, if one has decided. The other fields are:

    Parameters
    ----------
    file : str
        Name of the recording.
    false_alarm_probability : float
        Allowed probability of the verdict `leak` on a leak-free recording, from which `threshold` follows.
    quality : tuple of Finding
        Findings on the data.
    baselines : int
        Number of leak-free recordings with which the recording was compared.
    machine : AssumedMachine, optional
        Assumed sizes of the machine, and whether they were stated.
    limit : RepairLimit
        Smallest leak that calls for a repair.
    about : mapping of str to str
        Statements in the recording's file, such as operator, machine and oil temperature.
    start : str, optional
        Time at which the recording began, in ISO 8601 format, if the file states it.
    unused : tuple of str
        Recorded pressures, positions, speeds and flows that were not read as channels.
    pressure_unit : str
        Unit of pressures in texts: the log's unit if it is known, else bar.
    holds : tuple of HoldResult
        Results of the hold test, if the recording is one of a held load.

    Examples
    --------
    >>> import sealscope as ss
    >>> diagnosis = ss.diagnose(ss.simulate(leak="0.05 L/min from 30 s", duration="60 s", seed=1))
    >>> diagnosis
    Diagnosis('leak', file='recording', onset_s=29.95, leak_lpm=0.0508, score=175.8, threshold=18.86)
    >>> diagnosis.cause, f"{diagnosis.severity.creep_mm_per_min[0]:.0f} mm/min"
    ('piston or pump leak', '80 mm/min')
    >>> [evidence.detector for evidence in diagnosis.parts if evidence.abstains]
    ['rms change']
    >>> [round(end, 1) for end in diagnosis.as_dict()["onset_interval_s"]]
    [27.9, 31.4]
    """

    file: str = "recording"
    false_alarm_probability: float
    quality: tuple[Finding, ...] = ()
    baselines: int = 0
    machine: AssumedMachine | None = None
    limit: RepairLimit = field(default_factory=lambda: RepairLimit.parse(None))
    about: Mapping[str, str] = field(default_factory=dict)
    start: str | None = None
    unused: tuple[str, ...] = ()
    pressure_unit: str = "bar"
    holds: tuple[Any, ...] = ()

    @classmethod
    def from_evidence(
        cls, evidence: Evidence, recording: Recording, machine: AssumedMachine, *, file: str | None, **fields: Any
    ) -> Diagnosis:
        """Make the diagnosis of a recording from the combined evidence and from statements in the recording's file.

        The size of the leak relative to the `machine` is added if the evidence lacks it. `file` is the recording's
        name, by default that of its file; `fields` are the other fields of `Diagnosis`.
        """
        if evidence.relative is None:
            evidence = replace(evidence, relative=relative_leak(evidence, recording, machine))
        start = recording.provenance.get("start")
        return cls(
            **vars(evidence),
            file=file or str(recording.provenance.get("file", "recording")),
            machine=machine,
            about=recording.remarks,
            start=None if start is None else str(start),
            unused=recording.unused,
            pressure_unit=recording.pressure_unit,
            **fields,
        )

    @property
    def severity(self) -> Severity | None:
        """Severity of the leak relative to the repair limit; None if there is no leak or its size is unknown."""
        return severity(self, self.limit)

    @property
    def limit_lpm(self) -> float | None:
        """Repair limit as a flow past the piston [L/min]; None for a creep speed if nobody stated the piston area."""
        area = self.machine.area if self.machine is not None and self.machine.area_stated else None
        return self.limit.flow_lpm(area)

    @property
    def repair_lpm(self) -> float | None:
        """Repair limit [L/min] to draw in the plot of the leak over time (`course`); None without a plot.

        If the plot shows the leak alone, this is `limit_lpm`. If it shows the total leakage, that of the healthy
        machine is added: the median of the plotted flow before the onset or, without a finite onset, over the
        recording. From the latter a detected leak is subtracted, as it was open from the start. Also None if one of
        these is unknown.
        """
        course, limit = self.course, self.limit_lpm
        if course is None or limit is None:
            return None
        if not course.whole:  # the plot shows the leak alone
            return limit
        # without an onset: infinity, as all of the plotted flow counts
        onset = math.inf if self.onset_s is None or not math.isfinite(self.onset_s) else self.onset_s
        lpm_before = course.lpm[(course.t < onset) & np.isfinite(course.lpm)]
        if not lpm_before.size:
            return None
        median_lpm = float(np.median(lpm_before))
        if self.verdict == LEAK and onset == math.inf:  # the leak was open from the first sample on
            return None if self.leak_lpm is None else limit + max(0.0, median_lpm - self.leak_lpm)
        return limit + median_lpm

    @property
    def measured_ratio(self) -> tuple[float, tuple[float, float]] | None:
        """Measured over assumed ratio of pump displacement to piston area, with 95 % interval (low, high).

        It is that of the first detector with such a ratio, the deciding one first; None if no detector measured it.
        """
        for decision in (self, *self.parts):
            if decision.ratio is not None and decision.ratio_interval is not None:
                return decision.ratio, decision.ratio_interval
        return None

    @property
    def machine_name(self) -> str | None:
        """Name of the machine as stated in the recording's file; None if it is not stated."""
        return find_machine_name(self.about)

    @property
    def methods(self) -> tuple[Evidence, ...]:
        """Evidence of every detector, each followed by the evidence of the detector's single tests."""
        return tuple(evidence for detector in self.parts for evidence in (detector, *detector.parts))

    @property
    def _condition(self) -> str:
        """Name of the condition in `states.toml` that corresponds to the verdict, such as "leak" or "no change".

        With the verdict `no leak`, the leakage may be known to be healthy (`known_healthy`), and the recording may then
        serve as a baseline or not. Otherwise only a change within the recording was excluded, of the leakage or of the
        RMS.
        """
        if self.verdict != NO_LEAK:
            return self.verdict
        if self.missing_channels:
            return "channel missing"
        if self.known_healthy:
            return NO_LEAK if self.is_baseline else "no leak found"
        return "no change of RMS" if self.detector == RMS_CHANGE else "no change"

    @property
    def named_cause(self) -> str | None:
        """The `cause` if it fits the verdict: one of `LEAKS` with `leak`, another one with the others; else None."""
        return self.cause if (self.verdict == LEAK) == (self.cause in LEAKS) else None

    @property
    def missing_channels(self) -> tuple[Finding, ...]:
        """Findings on channels that the healthy recordings have and this one lacks; each states the remedy."""
        return tuple(finding for finding in self.quality if finding.code == MISSING_CHANNEL)

    @property
    def next_check(self) -> str:
        """Next check to make on the machine, in one or two sentences."""
        if self.holds:
            return self.holds[0].second_test or _NEXT_HOLD
        has_bypass = self.machine is not None and self.machine.bypass
        action = action_of(self._condition, self.named_cause, parts=("bypass",) if has_bypass else ())
        unlike = self.unlike_healthy
        return f"{action} Unlike them: {'; '.join(unlike)}." if unlike else action

    @property
    def state(self) -> MachineState:
        """State of the machine by NAMUR NE 107, such as "good"; "failure" for a leak surely over the repair limit."""
        is_over_limit = self.severity is not None and self.severity.level == "repair"
        condition = LEAK_OVER_LIMIT if is_over_limit else self._condition
        onset_s = to_plain(self.onset_s)  # None if not finite
        return state_of(condition, self.named_cause, since_s=onset_s, action=self.next_check)

    @property
    def known_healthy(self) -> bool:
        """True if there is no leak, and leak-free recordings or the rig show that the leakage is healthy."""
        is_healthy_by_rig = self.total_leakage is not None and self.total_leakage.healthy
        return self.verdict == NO_LEAK and (self.baselines > 0 or is_healthy_by_rig)

    @property
    def is_baseline(self) -> bool:
        """True if the recording may serve as a baseline, as no leak was found and its leakage is usual.

        It must have the channels of the healthy recordings. At least 1 in 20 of these must score as high in the
        comparison with healthy recordings, in the test for a step, and in the rarest of all tests (`rarest_chance`).
        The result is False without that comparison, or if a cause of a change is stated. If the total leakage is surely
        above 0, an undetected leak must not be the whole of it.
        """
        is_compared = self._find_test(AGAINST) is not None
        return self.verdict == NO_LEAK and self.cause is None and is_compared and not self.unlike_healthy

    @property
    def unlike_healthy(self) -> tuple[str, ...]:
        """Respects in which a recording without a leak is not shown to be like the healthy ones, in words.

        Empty if there are none, if a cause of a change is stated, or without a comparison with healthy recordings.
        """
        comparison = self._find_test(AGAINST)
        if self.verdict != NO_LEAK or self.cause is not None or comparison is None:
            return ()
        reasons = []
        if self.missing_channels:
            reasons.append("channels that they have are missing")
        if not _is_usual(comparison):
            reasons.append("the leakage above theirs, which fewer than 1 in 20 of them show")
        if self.rises_within:
            reasons.append("the leakage rises within the recording, as in fewer than 1 in 20 of them")
        if self.rarest_chance < _MIN_USUAL_CHANCE:
            reasons.append(f"{self.rarest_change or 'a change'}, as in fewer than 1 in 20 of them")
        total, bound_lpm = self.total_leakage, self.bound_lpm
        if total is not None and total.lpm is not None and total.interval_lpm is not None and bound_lpm is not None:
            min_total, _ = total.interval_lpm
            if min_total > 0.0 and bound_lpm >= total.lpm:
                reasons.append("a leak below the bound may be the whole of the leakage")
        return tuple(reasons)

    @property
    def rises_within(self) -> bool:
        """True if the leakage seems to rise within the recording (p-value below 0.05), but no onset is stated."""
        step_test = self._find_test(WITHIN)
        return self.onset_s is None and step_test is not None and not _is_usual(step_test)

    def _find_test(self, name: str) -> Evidence | None:
        """Find the evidence of a test of the deciding detector, such as `WITHIN`, by its `name`.

        None if there is no such test, or no other one: a detector lists its tests only if it has several.
        """
        tests = self.parts[0].parts if self.parts else ()  # the deciding detector is the first
        return next((test for test in tests if test.detector == name), None)

    def as_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain values for JSON, in the order of the output contract; None for nan or inf."""
        ratio, ratio_interval = self.measured_ratio or (None, None)
        total = None if self.total_leakage is None else dict(vars(self.total_leakage))
        if total is not None:
            total["pressure_Pa"] = total.pop("pressure")
        methods = [
            {"name": method.detector, "score": method.score, "threshold": method.threshold, "verdict": method.verdict}
            | {"reason": method.reason, "chance": method.chance, "odds": method.odds}
            for method in self.methods
        ]
        finding_names = ("code", "channel", "count", "first_t", "severity", "text")
        return to_plain(  # type: ignore[no-any-return]
            {
                **{name: getattr(self, name) for name in _FIRST_FIELDS},
                "methods": methods,
                "quality": [{name: getattr(finding, name) for name in finding_names} for finding in self.quality],
                "cause": self.cause,
                "next_check": self.next_check,
                "total_leakage": total,
                "chance": self.chance,
                "odds": self.odds,
                "summary": self.summary,
                "start": self.start,
                "machine": self.machine_name,
                "about": self.about,
                "rig": self.machine and self.machine.as_dict(),
                "severity": self.severity and self.severity.as_dict(),
                "limit": self.limit.as_dict(),
                "evidence": {"detector": self.detector or None, "share": self.share, "baselines": self.baselines}
                | {"ratio": ratio, "ratio_interval": ratio_interval, "refuses": sorted(self.refuses)},
                "state": self.state,
                "holds": [hold.as_dict() for hold in self.holds],
            }
        )

    def to_frame(self) -> pandas.DataFrame:
        """Return the diagnosis as a table of one row, for `pandas.concat`, with two columns for each interval.

        Raises MissingExtra if pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise MissingExtra("a table needs pandas: pip install 'sealscope[io]'") from None
        values = self.as_dict()
        row = {name: values[name] for name in _COLUMNS}
        for name in ("onset_interval_s", "leak_interval_lpm"):
            row[f"{name}_low"], row[f"{name}_high"] = values[name] or (None, None)
        return pandas.DataFrame([row])

    def plot(self, ax: matplotlib.axes.Axes | None = None) -> matplotlib.axes.Axes:
        """Draw the leak over the recording with its 95 % interval, the onset and the repair limit.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw into; by default the axes of a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            The axes.

        Raises
        ------
        InputError
            No detector states the leak over time.
        MissingExtra
            matplotlib is not installed.
        """
        if (course := self.course) is None:
            raise InputError(f"the diagnosis of {self.file} cannot be drawn, as no detector states the leak over time")
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise MissingExtra("a drawing needs matplotlib: pip install 'sealscope[report]'") from None
        axes = Figure(layout="constrained").subplots() if ax is None else ax
        axes.plot(course.t, course.lpm, label="pump and piston together" if course.whole else LEAK)
        axes.fill_between(course.t, course.low, course.high, alpha=0.3, label="95 % interval")
        if self.onset_s is not None:
            axes.axvline(self.onset_s, color="C3", label="onset")
        if self.repair_lpm is not None:
            axes.axhline(self.repair_lpm, color="C3", linestyle="--", label=f"repair limit ({self.limit})")
        axes.set(xlabel="t [s]", ylabel="leak [L/min]", title=f"{self.file}: {self.summary}")
        axes.legend()
        return axes

    def __str__(self) -> str:
        onset_text = "" if self.onset_s is None else f" since {self.onset_s:.1f} s"
        return f"{self.file}: {self.verdict}{onset_text} ({self.reason})"

    def __repr__(self) -> str:
        figures = {"onset_s": self.onset_s, "leak_lpm": self.leak_lpm, "score": self.score, "threshold": self.threshold}
        figures_text = "".join(f", {name}={value:.4g}" for name, value in figures.items() if value is not None)
        return f"Diagnosis({self.verdict!r}, file={self.file!r}{figures_text})"

    def _repr_html_(self) -> str:
        """Return the diagnosis as an HTML table for notebooks."""

        def format_figure(value: float | None, interval: tuple[float, float] | None = None) -> str:
            """Format a number with its interval, if any, to 4 digits; "" for None."""
            ends = "" if interval is None else f" ({interval[0]:.4g} to {interval[1]:.4g})"
            return "" if value is None else f"{value:.4g}{ends}"

        rows = [
            ("reason", self.reason),
            ("onset [s]", format_figure(self.onset_s, self.onset_interval_s)),
            ("leak [L/min]", format_figure(self.leak_lpm, self.leak_interval_lpm)),
            ("cause", self.cause),
            ("score", format_figure(self.score)),
            ("threshold", format_figure(self.threshold)),
            ("odds", self.odds),
            ("false-alarm probability", f"{self.false_alarm_probability:g}"),
            *((finding.severity, finding.text) for finding in self.quality),
            ("state", self.state.name),
            ("next check", self.next_check),
        ]
        body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows if text)
        return f"<table><caption>{escape(self.file)}: {escape(self.verdict)}</caption>{body}</table>"


def _is_usual(test: Evidence) -> bool:
    """Return True if at least 1 in 20 healthy recordings scores as high in the test, or if this is not known."""
    return test.chance is None or test.chance >= _MIN_USUAL_CHANCE


def find_machine_name(preamble: Mapping[str, str]) -> str | None:
    """Find the machine's name in the `preamble`, the statements by name at the beginning of a file; None if absent.

    Of several names in `_MACHINE_NAMES`, the first one counts; upper and lower case are not distinguished.
    """
    names = {name.lower(): text for name, text in preamble.items()}
    return next((names[name] for name in _MACHINE_NAMES if name in names), None)
