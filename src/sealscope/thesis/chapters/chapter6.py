"""Section 6.2, the thesis's future work: the loop closed over the piston, a leak in it, a load on it, valve or pump."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sealscope.control import FaultTolerant, controller_named
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Array
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import Trajectory, trajectory
from sealscope.thesis.engine.context import Context, first_table
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, Figure, FigureCurve, Panel, Role, ThesisTable
from sealscope.thesis.engine.texts import judge_claim, note
from sealscope.thesis.sines import sine_fit
from sealscope.units import LITRE_PER_MINUTE

RIG = "thesis-closed-loop"
#: The valve-controlled rig with the same cylinder, and what it is compared by.
VALVE_RIG, VALVE_CONTROLLERS = "servo-valve", ("pi", "flatness")
#: Damper [N s/m] that takes the work by which efficiency is reckoned: 1.3 kN at the duty's largest speed.
DAMPER = 20e3
#: What no controller knows: friction up and stiffness down by 20 %.
OFF: Mapping[str, float | str] = {"F_pr": 30.0, "F_cfr": 1.2e-6, "F_v": 360.0, "K_oil": 551e6}
#: Load [N], under which a leak has its size; leaks [L/min].
LOAD, LEAKS = 2000.0, (0.0, 0.0042, 0.05, 0.5)
#: Amplitude [m] and angular frequency [rad/s] of the duty; it stays within 10 V with the largest leak.
AMPLITUDE, OMEGA = 0.04, 0.5 * math.pi
#: Frequency [Hz] and amplitude [N] of the force that measures stiffness; frequencies [Hz] of small targets.
STIFF_AT, STIFF_FORCE = 0.5, 500.0
SMALL_AT, SMALL_SPEED = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0), 8e-3
CONTROLLERS = ("pi", "flatness", "fault-tolerant", "fault-tolerant-flatness", "ideal")
#: Columns of the tables that are drawn.
_ERROR, _STIFF, _ENERGY = "rms error [mm]", "stiffness at 0.5 Hz [N/mm]", "electrical energy a cycle [J]"
_ROLES: dict[tuple[str, ...], Role] = dict(
    zip(((name,) for name in CONTROLLERS), ("simulated", "25 %", "leak", "75 %", "reference"), strict=True)
)
_VALVE_ROLES: dict[tuple[str, ...], Role] = {
    ("pump", "pi"): "simulated",
    ("pump", "flatness"): "25 %",
    ("valve", "pi"): "leak",
    ("valve", "flatness"): "75 %",
}
#: Tracking and stiffness count as restored within this share of those without a leak.
RESTORED = 0.1
#: A drift [mm/min] that nobody would call one: a tenth of a millimetre.
STILL = 0.1
#: Two machines, or controllers, are told apart where one has this many times what the other has.
APART = 1.5
CYCLE = 2.0 * math.pi / OMEGA
DUTY = f"position {1e3 * AMPLITUDE} mm sin({OMEGA!r}t)"


def conductance(lpm: float, rig: Rig) -> float:
    """Compute the conductance [m^3/(s Pa)] of a leak of `lpm` [L/min] under the load."""
    return lpm * LITRE_PER_MINUTE / (LOAD / rig.cylinder.A_A)


@cache
def _rig(name: str = RIG) -> Rig:
    return load_rig(name)


def _swing(run: Trajectory, late: NDArray[np.bool_], f: float) -> float:
    """Compute the amplitude [m] of the piston at f [Hz] over some samples."""
    return float(np.abs(sine_fit(run.t[late], run["x"][late], 2 * math.pi * f).amplitudes[0]))


def supply_flow(run: Trajectory) -> Array:
    """Compute the flow [m^3/s] that a servo valve without overlap draws from its supply: that of its open edge."""
    return np.asarray(np.where(run["x_s"] > 0.0, run["Q_A"], -run["Q_B"]))


@dataclass(frozen=True)
class ControlledRig:
    """A rig whose friction and stiffness differ from the assumed ones, with a leak of `lpm` [L/min], under the load.

    `controller`: its name, "" for an open loop, `ideal` for one that knows the leak; `values`: other parameters.
    """

    controller: str
    lpm: float
    rig: str = RIG
    values: tuple[tuple[str, float], ...] = ()

    def run(self, command: str, duration: float, load: str = "0 N") -> Trajectory:
        """Run a command under `LOAD` and a further load."""
        rig = _rig(self.rig)
        size, controller = conductance(self.lpm, rig), None
        if self.controller:
            known = self.controller == "ideal"
            controller = FaultTolerant.from_rig(rig, known=size) if known else controller_named(self.controller, rig)
        experiment = Experiment.of(
            rig=rig,
            set={**OFF, "F_l": LOAD, **dict(self.values)},
            command=command,
            duration=duration,
            controller=controller,
            leak=f"G = {size!r}" if self.lpm else None,
            load=load,
        )
        return trajectory(experiment, experiment.leaks)

    def on_duty(self, load: str = "0 N") -> tuple[Trajectory, Array]:
        """Run five cycles of the duty; return the run, and which of its samples are of the last two."""
        run = self.run(DUTY, 5.0 * CYCLE, load)
        return run, np.asarray((run.t >= 3.0 * CYCLE) & (run.t < 5.0 * CYCLE))

    def stiffness(self) -> float:
        """Compute |F/x| [N/mm] in hold at `STIFF_AT`."""
        run = self.run("position 0 mm sin(t)", 16.0, f"{STIFF_FORCE} N sin({2 * math.pi * STIFF_AT!r}t)")
        late = run.t >= 8.0
        return STIFF_FORCE / (1e3 * _swing(run, late, STIFF_AT))

    def bandwidth(self) -> float:
        """Find the frequency [Hz] from which on small targets are missed by -3 dB of themselves or more."""
        terms = [f"{1e3 * SMALL_SPEED / (2 * math.pi * f):.6f} mm sin({2 * math.pi * f!r}t)" for f in SMALL_AT]
        run = self.run(f"position {' + '.join(terms)}", 14.0)
        late = run.t >= 8.0
        omegas = 2 * np.pi * np.array(SMALL_AT)
        target = -1j * SMALL_SPEED / omegas
        missed = np.abs(sine_fit(run.t[late], run["x"][late], *omegas).amplitudes / target - 1.0)
        too_fast = np.flatnonzero(missed > math.sqrt(0.5))
        if too_fast.size == 0 or too_fast[0] == 0:
            return math.inf if too_fast.size == 0 else SMALL_AT[0]
        k = int(too_fast[0])
        share = (math.sqrt(0.5) - missed[k - 1]) / (missed[k] - missed[k - 1])
        return float(SMALL_AT[k - 1] * (SMALL_AT[k] / SMALL_AT[k - 1]) ** share)

    def efficiencies(self) -> tuple[float, float]:
        """Compute two efficiencies on the duty against a damper alone.

        The damper's work over the electrical energy, and over the hydraulic energy that the cylinder takes: what a
        supply without losses would give to the valve at its pressure, or the pump to its ports.
        """
        run, late = replace(self, values=(("F_l", 0.0), ("d_load", DAMPER))).on_duty()
        flow = supply_flow(run) if _rig(self.rig).valve.spool == "present" else run["Q_1"]
        work = DAMPER * float(np.mean(run["v"][late] ** 2))
        power = flow * (run["p_1"] - run["p_2"])
        return work / float(np.mean((run["V"] * run["i"])[late])), work / float(np.mean(power[late]))


def tracking(run: Trajectory, late: Array) -> tuple[float, float, float]:
    """Compute the rms error [mm], the electrical energy of a cycle [J] and the compensated flow [L/min] on the duty."""
    error = AMPLITUDE * np.sin(OMEGA * run.t[late]) - run["x"][late]
    flow = 0.0 if run.compensated is None else float(np.mean(run.compensated[late])) / LITRE_PER_MINUTE
    return 1e3 * float(np.sqrt(np.mean(error**2))), float(np.mean(run["V"][late] * run["i"][late])) * CYCLE, flow


def controllers_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Tabulate and draw error, bandwidth, energy and stiffness of each controller against the size of the leak."""
    rows: list[tuple[Cell, ...]] = []
    for name, lpm in itertools.product(CONTROLLERS, _leaks(context)):
        loop = ControlledRig(name, lpm)
        error, energy, flow = tracking(*loop.on_duty())
        rows.append((name, lpm, error, loop.bandwidth(), energy, loop.stiffness(), flow))
    notes = note("controllers", rig=RIG, load=LOAD, mm=1e3 * AMPLITUDE, f=1 / CYCLE)
    table = item.table(rows, notes)
    return table, _against_the_leak(table, "Error and stiffness against the leak", _ROLES, (_ERROR, _STIFF))


def _leaks(context: Context) -> tuple[float, ...]:
    return (0.0, 0.5) if context.quick else LEAKS


def _against_the_leak(
    table: ThesisTable, title: str, roles: Mapping[tuple[str, ...], Role], columns: Sequence[str], log_y: bool = False
) -> Figure:
    """Draw columns of a table over the leak, a curve for each of the names in its first columns."""
    panels = []
    for column in columns:
        curves = []
        for names, role in roles.items():
            group = [row for row in table.rows if row[: len(names)] == names]
            places = len(names), table.columns.index(column)
            x, y = (np.array([float(row[k] or 0.0) for row in group]) for k in places)
            curves.append(FigureCurve(np.maximum(x, 0.001), y, ", ".join(names), role))
        panels.append(Panel("leak [L/min], none drawn at 0.001", column, tuple(curves), log_x=True, log_y=log_y))
    return Figure(f"{table.id}-figure", title, tuple(panels), notes=table.notes)


def open_loop_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the drift of the piston's middle with a leak, in the open loop and in two closed ones."""
    rows: list[tuple[Cell, ...]] = []
    u, still = 7.3, 0.0

    def drift(run: Trajectory, first: int) -> float:
        """Compute the shift of the middle of a cycle to the next [mm/min]."""
        middle = [float(np.mean(run["x"][_cycle_of(run.t, k)])) for k in (first, first + 1)]
        return 60e3 * (middle[1] - middle[0]) / CYCLE

    for lpm in _leaks(context):
        opened = ControlledRig("", lpm).run(f"{u} sin({OMEGA!r}t + {0.5 * math.pi!r})", 3.0 * CYCLE)
        still = drift(opened, 1) if lpm == 0.0 else still
        late = opened.t >= CYCLE
        size = 1e3 * _swing(opened, late, 1 / CYCLE)
        closed = [drift(ControlledRig(name, lpm).run(DUTY, 4.0 * CYCLE), 2) for name in ("pi", "fault-tolerant")]
        rows.append((lpm, size, drift(opened, 1), drift(opened, 1) - still, *closed))
    return (item.table(rows, note("open-loop", rig=RIG, load=LOAD, u=u)),)


def _cycle_of(t: Array, k: int) -> Array:
    return np.asarray((t >= k * CYCLE) & (t < (k + 1) * CYCLE))


def load_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the error on the duty against the load, without a leak and with the middle one."""
    loops = [ControlledRig(name, lpm) for name in ("pi", "flatness", "fault-tolerant") for lpm in (0.0, 0.05)]
    heads = ["load [N]"]
    for loop in loops:
        heads += [f"{loop.controller}, {loop.lpm:g} L/min: {what}" for what in (_ERROR, "energy a cycle [J]")]
    rows = []
    for force in (0.0, 2000.0) if context.quick else (0.0, 500.0, 1000.0, 2000.0):
        pairs = (tracking(*loop.on_duty(f"{force - LOAD!r} N"))[:2] for loop in loops)
        rows.append((force, *itertools.chain.from_iterable(pairs)))
    return (item.table(rows, note("load"), heads),)


def outside_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate tracking and stiffness where oil leaves the circuit past a rod seal of either side."""
    healthy, late = ControlledRig("pi", 0.0).on_duty()
    pressure = {side: float(np.mean(healthy[f"p_{side}"][late])) for side in ("A", "B")}
    names, leaks = (CONTROLLERS[:1], (0.5,)) if context.quick else (CONTROLLERS[:4], LEAKS[1:])
    rows: list[tuple[Cell, ...]] = []
    for side, name, lpm in itertools.product(pressure, names, leaks):
        loop = ControlledRig(name, 0.0, values=((f"G_ext_{side}", lpm * LITRE_PER_MINUTE / pressure[side]),))
        run, late = loop.on_duty()
        lower = np.minimum(run["p_A"], run["p_B"])
        third, fifth = (1e-3 * float(np.mean(lower[_cycle_of(run.t, k)])) for k in (2, 4))
        error, _, flow = tracking(run, late)
        rows.append((side, name, lpm, error, loop.stiffness(), flow, fifth - third))
    notes = note("outside", rig=RIG, load=LOAD, A=1e-6 * pressure["A"], B=1e-6 * pressure["B"])
    return (item.table(rows, notes),)


def valve_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Tabulate and draw tracking, stiffness and energy of the pump-controlled and the valve-controlled rig."""
    rigs = {"pump": RIG, "valve": VALVE_RIG}
    rows: list[tuple[Cell, ...]] = []
    for (source, rig), name, lpm in itertools.product(rigs.items(), VALVE_CONTROLLERS, _leaks(context)):
        loop = ControlledRig(name, lpm, rig)
        run, late = loop.on_duty()
        error, energy, _ = tracking(run, late)
        pump_energy = float(np.mean((run["Q_1"] * (run["p_1"] - run["p_2"]))[late])) * CYCLE  # by the pump
        efficiencies = [100 * share for share in loop.efficiencies()]
        rows.append((source, name, lpm, error, loop.bandwidth(), loop.stiffness(), energy, pump_energy, *efficiencies))
    notes = note("valve", rig=RIG, other=VALVE_RIG, mm=1e3 * AMPLITUDE, f=1 / CYCLE, load=LOAD, damper=DAMPER)
    table, title = item.table(rows, notes), "Energy and stiffness, pump and valve"
    return table, _against_the_leak(table, title, _VALVE_ROLES, (_ENERGY, _STIFF), log_y=True)


def _rows(context: Context, item: str, names: int) -> dict[tuple[str, ...], dict[float, list[float]]]:
    """Read the numbers of a table by its first `names` columns and by the leak [L/min] in the next."""
    by: dict[tuple[str, ...], dict[float, list[float]]] = {}
    for row in first_table(context, item).rows:
        leak, *numbers = (float(cell) for cell in row[names:] if isinstance(cell, int | float))
        by.setdefault(tuple(map(str, row[:names])), {})[leak] = numbers
    return by


def judge_claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 6.2.1 to 6.2.4."""
    return _disturbance(context), _tolerance(context), _load(context), _valves(context)


def _disturbance(context: Context) -> Claim:
    rows = {lpm: row[2:4] for lpm, row in _rows(context, "sec-6.2-open-loop", 0)[()].items() if lpm > 0}
    texts = [f"{lpm:g} L/min: {opened:.1f} open, {closed:.2f} closed" for lpm, (opened, closed) in rows.items()]
    return judge_claim("6.2.1", [abs(closed) < STILL for _, closed in rows.values()], drifts="; ".join(texts))


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
    return judge_claim(
        "6.2.2", [*tests, unharmed], pairs="; ".join(texts), error=error, stiffness=stiffness, unless=unless
    )


def _load(context: Context) -> Claim:
    rows = _rows(context, "sec-6.2-load", 0)[()].values()
    spread = {}
    for column, name in ((0, "pi"), (4, "flatness"), (8, "fault-tolerant")):
        errors = [row[column] for row in rows]
        spread[name] = min(errors), max(errors)
    least, worst = max(low for low, _ in spread.values()), [high for _, high in spread.values()]
    text = "; ".join(f"{name} {low:.3f} to {high:.3f} mm" for name, (low, high) in spread.items())
    return judge_claim("6.2.3", [max(worst) > APART * min(worst)], spread=text, near=max(worst) < 0.4, least=least)


def _valves(context: Context) -> Claim:
    rows = _rows(context, "sec-6.2-valve", 2)
    pump, valve = rows["pump", "pi"], rows["valve", "pi"]
    largest = max(pump)
    tests = [max(ends) > APART * min(ends) for ends in ((pump[0.0][k], valve[0.0][k]) for k in (5, 0))]
    worn = pump[largest], valve[largest]
    return judge_claim("6.2.4", tests, pump=pump[0.0], valve=valve[0.0], largest=largest, worn=worn)
