"""What section 6.2 expects of its future work, judged by the studies that it names."""

from __future__ import annotations

from sealscope.thesis.claims.judged import judged
from sealscope.thesis.engine.context import Context, first_table
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim

#: Tracking and stiffness count as restored within this share of those without a leak.
RESTORED = 0.1
#: A drift [mm/min] that nobody would call one: a tenth of a millimetre.
STILL = 0.1
#: Two machines, or controllers, are told apart where one has this many times what the other has.
APART = 1.5


def _rows(context: Context, item: str, names: int) -> dict[tuple[str, ...], dict[float, list[float]]]:
    """Return the numbers of a table by its first `names` columns and by the leak [L/min] in the next."""
    by: dict[tuple[str, ...], dict[float, list[float]]] = {}
    for row in first_table(context, item).rows:
        leak, *numbers = (float(cell) for cell in row[names:] if isinstance(cell, int | float))
        by.setdefault(tuple(map(str, row[:names])), {})[leak] = numbers
    return by


def claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 6.2.1 to 6.2.4."""
    return _disturbance(context), _tolerance(context), _load(context), _valves(context)


def _disturbance(context: Context) -> Claim:
    rows = {lpm: row[2:4] for lpm, row in _rows(context, "sec-6.2-open-loop", 0)[()].items() if lpm > 0}
    texts = [f"{lpm:g} L/min: {opened:.1f} open, {closed:.2f} closed" for lpm, (opened, closed) in rows.items()]
    return judged("6.2.1", [abs(closed) < STILL for _, closed in rows.values()], drifts="; ".join(texts))


def _tolerance(context: Context) -> Claim:
    rows = _rows(context, "sec-6.2-controllers", 1)
    fixed, tolerant = rows[("pi",)], rows[("fault-tolerant",)]
    error, _, _, stiffness, _ = fixed[0.0]
    tests, texts = [], []
    for lpm in sorted(lpm for lpm in fixed if lpm > 0):
        a, b = fixed[lpm], tolerant[lpm]
        tests += [b[0] <= (1 + RESTORED) * error, b[3] >= (1 - RESTORED) * stiffness]
        texts.append(f"{lpm:g} L/min: {a[0]:.3f} and {b[0]:.3f} mm, {a[3]:.0f} and {b[3]:.0f} N/mm")
    unharmed = tolerant[0.0][0] == error and tolerant[0.0][4] == 0.0
    unless = "" if unharmed else " NOT"
    return judged("6.2.2", [*tests, unharmed], pairs="; ".join(texts), error=error, stiffness=stiffness, unless=unless)


def _load(context: Context) -> Claim:
    rows = _rows(context, "sec-6.2-load", 0)[()].values()
    spread = {}
    for column, name in ((0, "pi"), (4, "flatness"), (8, "fault-tolerant")):
        errors = [row[column] for row in rows]
        spread[name] = min(errors), max(errors)
    least, worst = max(low for low, _ in spread.values()), [high for _, high in spread.values()]
    text = "; ".join(f"{name} {low:.3f} to {high:.3f} mm" for name, (low, high) in spread.items())
    return judged("6.2.3", [max(worst) > APART * min(worst)], spread=text, near=max(worst) < 0.4, least=least)


def _valves(context: Context) -> Claim:
    rows = _rows(context, "sec-6.2-valve", 2)
    pump, valve = rows["pump", "pi"], rows["valve", "pi"]
    largest = max(pump)
    tests = [max(ends) > APART * min(ends) for ends in ((pump[0.0][k], valve[0.0][k]) for k in (5, 0))]
    worn = pump[largest], valve[largest]
    return judged("6.2.4", tests, pump=pump[0.0], valve=valve[0.0], largest=largest, worn=worn)


_NEEDS = tuple(f"sec-6.2-{name}" for name in ("open-loop", "controllers", "load", "valve"))
ITEMS: tuple[Item, ...] = (Item("chapter-6-claims", 6, "claims", "What section 6.2 expects", claims, needs=_NEEDS),)
