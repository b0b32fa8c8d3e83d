"""The 41 leakage tests of Appendix C as conditions: what was commanded, how the throttles stood, how much leaked.

Only the inputs of the tests are here. What was measured in them is not part of the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["extra-small", "small", "medium", "large"]


@dataclass(frozen=True)
class Condition:
    """One test of Appendix C; `number` counts the rows from 1, in the order printed.

    `command` in the words of `parse_command`; `closed_pct` [%] of both throttles; `mean_leak_lpm` [L/min] after the
    bypass valve was opened; `level` the needle's position, which is not a measure of the leak (a "large" needle leaks
    10 to 16 mL/min, an "extra-small" one 4 to 14).
    """

    number: int
    command: str
    closed_pct: float
    mean_leak_lpm: float
    level: Level

    @property
    def group(self) -> tuple[str, float]:
        """Command and throttle: tests that share it are repeats of one operating condition."""
        return self.command, self.closed_pct


def experiment_values(condition: Condition) -> dict[str, str | float]:
    """The rig's parameters that a test sets, by name, for `Rig.with_overrides` or `Experiment.of(set=...)`.

    Both throttles are closed alike. A test with the throttles fully open leaves `line.orifices` as the rig has it:
    absent in the thesis's model (section 4.2.1), present in a rig whose open valve bodies stay in the line.
    """
    closed = condition.closed_pct / 100.0
    values: dict[str, str | float] = {"line.closed_A": closed, "line.closed_B": closed}
    if closed > 0:
        values["line.orifices"] = "present"
    return values


#: The tests of Appendix C of "Understanding Effect and Diagnosis of Internal Leakage in Hydrostatic Actuation
#: Systems", in its order.
APPENDIX_C: tuple[Condition, ...] = (
    Condition(1, "8 sin(t)", 50.0, 0.0042, "extra-small"),
    Condition(2, "8 sin(t)", 25.0, 0.0047, "extra-small"),
    Condition(3, "8 sin(t)", 25.0, 0.0048, "extra-small"),
    Condition(4, "8 sin(t)", 50.0, 0.0048, "extra-small"),
    Condition(5, "7 sin(4t)", 75.0, 0.0051, "extra-small"),
    Condition(6, "7 sin(4t)", 75.0, 0.0055, "extra-small"),
    Condition(7, "5 sin(2t)", 75.0, 0.0057, "extra-small"),
    Condition(8, "5 sin(2t)", 75.0, 0.0062, "extra-small"),
    Condition(9, "5 sin(2t)", 50.0, 0.0067, "extra-small"),
    Condition(10, "5 sin(2t)", 50.0, 0.0071, "extra-small"),
    Condition(11, "3 sin(4t)", 75.0, 0.0071, "extra-small"),
    Condition(12, "3 sin(4t)", 75.0, 0.0073, "extra-small"),
    Condition(13, "8 sin(t)", 0.0, 0.0074, "small"),
    Condition(14, "7 sin(4t)", 50.0, 0.0077, "extra-small"),
    Condition(15, "7 sin(4t)", 50.0, 0.0078, "extra-small"),
    Condition(16, "7 sin(4t)", 25.0, 0.0081, "extra-small"),
    Condition(17, "7 sin(4t)", 25.0, 0.0084, "extra-small"),
    Condition(18, "5 sin(2t)", 25.0, 0.0085, "extra-small"),
    Condition(19, "5 sin(2t)", 25.0, 0.0087, "extra-small"),
    Condition(20, "7 sin(4t)", 0.0, 0.0092, "extra-small"),
    Condition(21, "8 sin(t)", 0.0, 0.0095, "medium"),
    Condition(22, "8 sin(t)", 0.0, 0.0096, "small"),
    Condition(23, "5 sin(2t)", 0.0, 0.0097, "extra-small"),
    Condition(24, "8 sin(t)", 0.0, 0.0103, "large"),
    Condition(25, "7 sin(4t)", 0.0, 0.0108, "small"),
    Condition(26, "3 sin(4t)", 50.0, 0.0112, "extra-small"),
    Condition(27, "3 sin(4t)", 50.0, 0.0113, "extra-small"),
    Condition(28, "5 sin(2t)", 0.0, 0.012, "small"),
    Condition(29, "3 sin(4t)", 25.0, 0.0132, "extra-small"),
    Condition(30, "3 sin(4t)", 25.0, 0.0135, "extra-small"),
    Condition(31, "5 sin(2t)", 0.0, 0.0139, "large"),
    Condition(32, "3 sin(4t)", 0.0, 0.014, "extra-small"),
    Condition(33, "7 sin(4t)", 0.0, 0.0144, "medium"),
    Condition(34, "7 sin(4t)", 0.0, 0.0145, "large"),
    Condition(35, "3 sin(4t)", 0.0, 0.0152, "small"),
    Condition(36, "7 sin(4t)", 0.0, 0.0156, "medium"),
    Condition(37, "3 sin(4t)", 0.0, 0.0159, "medium"),
    Condition(38, "3 sin(4t)", 0.0, 0.016, "medium"),
    Condition(39, "3 sin(4t)", 0.0, 0.0163, "large"),
    Condition(40, "5 sin(2t)", 0.0, 0.0163, "medium"),
    Condition(41, "5 sin(2t)", 0.0, 0.0185, "medium"),
)


def groups(conditions: tuple[Condition, ...] = APPENDIX_C) -> tuple[tuple[str, float], ...]:
    """The different operating conditions (command, closed [%]) in order of first appearance."""
    return tuple(dict.fromkeys(condition.group for condition in conditions))
