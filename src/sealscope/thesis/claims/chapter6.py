"""What section 6.2 expects of its future work, judged by the studies that it names."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, ThesisTable, verdict_of

if TYPE_CHECKING:
    from sealscope.thesis.engine.context import Context

_ABSENT = "no closed loop in the sheet"
#: Tracking and stiffness count as restored within this share of those without a leak.
RESTORED = 0.1
#: A drift [mm/min] that nobody would call one: a tenth of a millimetre.
STILL = 0.1
#: Two machines are told apart where one has this many times what the other has.
APART = 1.5


def _table(context: Context, item: str) -> ThesisTable:
    return next(product for product in context.product(item) if isinstance(product, ThesisTable))


def _value(cell: object) -> float:
    assert isinstance(cell, int | float)
    return float(cell)


def claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 6.2.1 to 6.2.4."""
    return _disturbance(context), _tolerance(context), _load(context), _valves(context)


def _disturbance(context: Context) -> Claim:
    rows = _table(context, "sec-6.2-open-loop").rows
    by_leak = [(_value(row[0]), *(_value(cell) for cell in row[3:5])) for row in rows if _value(row[0]) > 0]
    text = "; ".join(f"{lpm:g} L/min: {opened:.1f} open, {closed:.2f} closed" for lpm, opened, closed in by_leak)
    return Claim(
        "claim-6.2.1",
        "section 6.2",
        "A loop closed over the piston's displacement makes good what disturbs it from outside.",
        _ABSENT,
        f"drift by the leak under 2 kN [mm/min]: {text}",
        verdict_of([abs(closed) < STILL for _, _, closed in by_leak]),
        "Holds of a controller with an integral. What a leak moves in the open loop, the closed one hides in its "
        "command.",
    )


def _tolerance(context: Context) -> Claim:
    rows = _table(context, "sec-6.2-controllers").rows
    by = {(str(row[0]), _value(row[1])): [_value(cell) for cell in row[1:]] for row in rows}
    leaks = sorted({lpm for _, lpm in by if lpm > 0})
    healthy = by["pi", 0.0]
    tests: list[bool] = []
    texts: list[str] = []
    for lpm in leaks:
        fixed, tolerant = by["pi", lpm], by["fault-tolerant", lpm]
        tests += [tolerant[1] <= (1 + RESTORED) * healthy[1], tolerant[4] >= (1 - RESTORED) * healthy[4]]
        texts.append(
            f"{lpm:g} L/min: {fixed[1]:.3f} and {tolerant[1]:.3f} mm, {fixed[4]:.0f} and {tolerant[4]:.0f} N/mm"
        )
    unharmed = by["fault-tolerant", 0.0][1] == healthy[1] and by["fault-tolerant", 0.0][5] == 0.0
    return Claim(
        "claim-6.2.2",
        "section 6.2",
        "With a leak across the piston, a fault-tolerant controller makes the closed loop more effective.",
        _ABSENT,
        f"rms error and stiffness, fixed and tolerant: {'; '.join(texts)}; without a leak {healthy[1]:.3f} mm, "
        f"{healthy[4]:.0f} N/mm, and the tolerant one is the fixed one" + ("" if unharmed else " NOT"),
        verdict_of([*tests, unharmed]),
        "Holds where tracking and stiffness are within 10 % of those without a leak, and nothing is lost without one. "
        "Internal leaks only: oil that leaves the circuit was not studied here.",
    )


def _load(context: Context) -> Claim:
    rows = _table(context, "sec-6.2-load").rows
    spread = []
    for column, name in ((1, "pi"), (5, "flatness"), (9, "fault-tolerant")):
        errors = [_value(row[column]) for row in rows]
        spread.append((name, min(errors), max(errors)))
    least, most = (max(pair) for pair in ([s[1] for s in spread], [s[2] for s in spread]))
    text = "; ".join(f"{name} {low:.3f} to {high:.3f} mm" for name, low, high in spread)
    differs = max(s[2] for s in spread) > 1.5 * min(s[2] for s in spread)
    return Claim(
        "claim-6.2.3",
        "section 6.2",
        "A force on the cylinder tells controllers of the piston's displacement apart.",
        _ABSENT,
        f"rms error over loads of 0 to 2 kN, no leak: {text}",
        verdict_of([differs]),
        f"Told apart where the worst errors differ by half or more. All are within 1 % of 40 mm: {most < 0.4} "
        f"(least {least:.3f} mm).",
    )


def _valves(context: Context) -> Claim:
    rows = _table(context, "sec-6.2-valve").rows
    by = {(str(row[0]), str(row[1]), _value(row[2])): [_value(cell) for cell in row[3:]] for row in rows}
    largest = max(lpm for *_, lpm in by)
    pump, valve = by["pump", "pi", 0.0], by["valve", "pi", 0.0]
    worn = [by[source, "pi", largest] for source in ("pump", "valve")]

    def apart(column: int) -> bool:
        return max(pump[column], valve[column]) > APART * min(pump[column], valve[column])

    return Claim(
        "claim-6.2.4",
        "section 6.2",
        "A comparison of valve-controlled and pump-controlled machines would be informative.",
        _ABSENT,
        f"pump and valve without a leak: efficiency {pump[5]:.0f} and {valve[5]:.1f} % (from what the cylinder takes "
        f"{pump[6]:.0f} and {valve[6]:.0f} %), rms error {pump[0]:.3f} and {valve[0]:.3f} mm, stiffness {pump[2]:.0f} "
        f"and {valve[2]:.0f} N/mm; with {largest:g} L/min {worn[0][0]:.3f} and {worn[1][0]:.3f} mm, {worn[0][2]:.0f} "
        f"and {worn[1][2]:.0f} N/mm",
        verdict_of([apart(5), apart(0)]),
        "Informative where both efficiency and tracking differ by half or more. The supply turns at a constant speed; "
        "one that gives what is drawn at its pressure has the second efficiency. The smallest leak that each lets be "
        "found is not part of this study.",
    )


ITEMS: tuple[Item, ...] = (
    Item(
        "chapter-6-claims",
        6,
        "claims",
        "What section 6.2 expects",
        claims,
        needs=("sec-6.2-open-loop", "sec-6.2-controllers", "sec-6.2-load", "sec-6.2-valve"),
    ),
)
