"""Section 6.2, the thesis's future work: the loop closed over the piston, a leak in it, a load on it, valve or pump."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.recording import Array
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Panel, Role, ThesisTable

if TYPE_CHECKING:
    from sealscope.control import Controller
    from sealscope.parameters import Rig
    from sealscope.simulation.integrate import Trajectory

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
_ROLES: dict[str, Role] = {
    "pi": "simulated",
    "flatness": "25 %",
    "fault-tolerant": "leak",
    "fault-tolerant-flatness": "75 %",
    "ideal": "reference",
}
COLUMNS = (
    "controller",
    "leak [L/min]",
    "rms error [mm]",
    "bandwidth [Hz]",
    "energy a cycle [J]",
    "stiffness at 0.5 Hz [N/mm]",
    "made good [L/min]",
)
OUTSIDE_COLUMNS = (
    "rod seal",
    "controller",
    "leak [L/min]",
    "rms error [mm]",
    "stiffness at 0.5 Hz [N/mm]",
    "made good [L/min]",
    "lower pressure, fifth cycle less third [kPa]",
)
VALVE_COLUMNS = (
    "source",
    "controller",
    "leak [L/min]",
    "rms error [mm]",
    "bandwidth [Hz]",
    "stiffness at 0.5 Hz [N/mm]",
    "electrical energy a cycle [J]",
    "hydraulic energy a cycle [J]",
    "efficiency against a damper [%]",
    "efficiency from what the cylinder takes [%]",
)


def conductance(lpm: float, rig: Rig) -> float:
    """Return the conductance [m^3/(s Pa)] of a leak of `lpm` [L/min] under the load."""
    return lpm / 6e4 / (LOAD / rig.cylinder.A_A)


def controller_of(name: str, rig: Rig, lpm: float) -> Controller:
    """Return a controller by its name; `ideal` knows the leak."""
    from sealscope.control import FaultTolerant, controller_named

    if name == "ideal":
        return FaultTolerant.of(rig, known=conductance(lpm, rig))
    return controller_named(name, rig)


def followed(
    command: str,
    duration: float,
    controller: Controller | None,
    lpm: float,
    load: str,
    rig: str = RIG,
    values: Mapping[str, float | str] | None = None,
) -> Trajectory:
    """Run a rig whose friction and stiffness are off, under a load in words beside `LOAD`."""
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.integrate import trajectory

    leak = f"G = {conductance(lpm, _rig(rig))!r}" if lpm else None
    experiment = Experiment.of(
        rig=_rig(rig),
        set={**OFF, "F_l": LOAD, **(values or {})},
        command=command,
        duration=duration,
        controller=controller,
        leak=leak,
        load=load,
    )
    return trajectory(experiment, experiment.leaks)


@cache
def _rig(name: str = RIG) -> Rig:
    from sealscope.parameters import load_rig

    return load_rig(name)


def amplitude_at(t: Array, values: Array, f: float) -> complex:
    """Return the complex amplitude of a signal at f [Hz], by least squares with a constant and a slope beside."""
    X = np.stack([np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t), np.ones(t.size), t - t.mean()], axis=1)
    a = np.linalg.lstsq(X, values, rcond=None)[0]
    return complex(a[0], -a[1])


def on_duty(
    name: str, lpm: float, load: str = "0 N", rig: str = RIG, values: Mapping[str, float | str] | None = None
) -> tuple[Trajectory, Array]:
    """Return a run of five cycles of the duty, and which of its samples are of the last two."""
    cycle = 2.0 * math.pi / OMEGA
    command = f"position {1e3 * AMPLITUDE} mm sin({OMEGA!r}t)"
    run = followed(command, 5.0 * cycle, controller_of(name, _rig(rig), lpm), lpm, load, rig, values)
    return run, np.asarray((run.t >= 3.0 * cycle) & (run.t < 5.0 * cycle))


def tracking(name: str, lpm: float, load: str = "0 N", rig: str = RIG) -> tuple[float, float, float]:
    """Return the rms error [mm], the electrical energy of a cycle [J] and the flow made good [L/min] on the duty."""
    run, late = on_duty(name, lpm, load, rig)
    error, flow = _error_and_flow(run, late)
    return error, float(np.mean(run["V"][late] * run["i"][late])) * 2.0 * math.pi / OMEGA, flow


def _error_and_flow(run: Trajectory, late: Array) -> tuple[float, float]:
    """Return the rms error [mm] and the flow made good [L/min] of a run of the duty."""
    error = AMPLITUDE * np.sin(OMEGA * run.t[late]) - run["x"][late]
    flow = 0.0 if run.compensated is None else float(np.mean(run.compensated[late])) * 6e4
    return 1e3 * float(np.sqrt(np.mean(error**2))), flow


def drawn(run: Trajectory) -> Array:
    """Return the flow [m^3/s] that a servo valve without overlap draws from its supply: that of its open edge."""
    return np.asarray(np.where(run["x_s"] > 0.0, run["Q_A"], -run["Q_B"]))


def energies(name: str, lpm: float, rig: str) -> tuple[float, float, float]:
    """Return the hydraulic energy of a cycle [J] on the duty, and two efficiencies against a damper alone.

    Hydraulic energy: what the pump gives, Q_1 (p_1 - p_2). Efficiency: the damper's work over the electrical energy,
    and over the hydraulic energy that the cylinder takes: what a supply without losses would give to the valve at its
    pressure, or the pump to its ports.
    """
    cycle = 2.0 * math.pi / OMEGA
    run, late = on_duty(name, lpm, rig=rig)
    given = float(np.mean((run["Q_1"] * (run["p_1"] - run["p_2"]))[late])) * cycle
    damped, late = on_duty(name, lpm, rig=rig, values={"F_l": 0.0, "d_load": DAMPER})
    dp = damped["p_1"] - damped["p_2"]
    taken = (drawn(damped) if _rig(rig).valve.spool == "present" else damped["Q_1"]) * dp
    work = DAMPER * float(np.mean(damped["v"][late] ** 2))
    electrical = float(np.mean((damped["V"] * damped["i"])[late]))
    return given, work / electrical, work / float(np.mean(taken[late]))


def stiffness(name: str, lpm: float, rig: str = RIG, values: Mapping[str, float | str] | None = None) -> float:
    """Return |F/x| [N/mm] in hold at `STIFF_AT`."""
    load = f"{STIFF_FORCE} N sin({2 * math.pi * STIFF_AT!r}t)"
    run = followed("position 0 mm sin(t)", 16.0, controller_of(name, _rig(rig), lpm), lpm, load, rig, values)
    late = run.t >= 8.0
    return STIFF_FORCE / (1e3 * abs(amplitude_at(run.t[late], run["x"][late], STIFF_AT)))


def bandwidth(name: str, lpm: float, rig: str = RIG) -> float:
    """Return the frequency [Hz] from which on small targets are missed by -3 dB of themselves or more."""
    terms = [f"{1e3 * SMALL_SPEED / (2 * math.pi * f):.6f} mm sin({2 * math.pi * f!r}t)" for f in SMALL_AT]
    run = followed(f"position {' + '.join(terms)}", 14.0, controller_of(name, _rig(rig), lpm), lpm, "0 N", rig)
    late = run.t >= 8.0
    X = [np.ones(int(late.sum()))]
    for f in SMALL_AT:
        X += [np.cos(2 * np.pi * f * run.t[late]), np.sin(2 * np.pi * f * run.t[late])]
    a = np.linalg.lstsq(np.stack(X, axis=1), run["x"][late], rcond=None)[0]
    target = SMALL_SPEED / (2 * np.pi * np.array(SMALL_AT))
    missed = np.hypot(a[1::2], target - a[2::2]) / target
    beyond = np.flatnonzero(missed > math.sqrt(0.5))
    if beyond.size == 0 or beyond[0] == 0:
        return math.inf if beyond.size == 0 else SMALL_AT[0]
    k = int(beyond[0])
    share = (math.sqrt(0.5) - missed[k - 1]) / (missed[k] - missed[k - 1])
    return float(SMALL_AT[k - 1] * (SMALL_AT[k] / SMALL_AT[k - 1]) ** share)


def controllers_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Tabulate and draw error, bandwidth, energy and stiffness of each controller against the size of the leak."""
    leaks = (0.0, 0.5) if context.quick else LEAKS
    rows: list[tuple[Cell, ...]] = []
    for name in CONTROLLERS:
        for lpm in leaks:
            error, energy, flow = tracking(name, lpm)
            rows.append((name, lpm, error, bandwidth(name, lpm), energy, stiffness(name, lpm), flow))
    notes = (
        f"{RIG}, friction +20 % and bulk modulus -20 % against what the controllers assume, {LOAD:g} N, leak sized at "
        f"it; {1e3 * AMPLITUDE:g} mm at {OMEGA / (2 * math.pi):g} Hz. `ideal` knows the leak, nobody else does."
    )
    panels = []
    for column, label in ((2, "rms error [mm]"), (5, "stiffness at 0.5 Hz [N/mm]")):
        curves = []
        for name in CONTROLLERS:
            own = [row for row in rows if row[0] == name]
            x, y = (np.array([float(row[k] or 0.0) for row in own]) for k in (1, column))
            curves.append(FigureCurve(np.maximum(x, 0.001), y, name, _ROLES[name]))
        panels.append(Panel("leak [L/min], none drawn at 0.001", label, tuple(curves), log_x=True))
    table = ThesisTable(item.id, item.title, COLUMNS, tuple(rows), notes=notes)
    return table, Figure(f"{item.id}-figure", "Error and stiffness against the leak", tuple(panels), notes=notes)


def open_loop_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate where the piston's middle goes with a leak, in the open loop and in two closed ones."""
    rows: list[tuple[Cell, ...]] = []
    cycle, u = 2.0 * math.pi / OMEGA, 7.3
    still = 0.0
    for lpm in (0.0, 0.5) if context.quick else LEAKS:
        opened = followed(f"{u} sin({OMEGA!r}t + {0.5 * math.pi!r})", 3.0 * cycle, None, lpm, "0 N")
        middle = [float(np.mean(opened["x"][_cycle_of(opened.t, k)])) for k in (1, 2)]
        drift = 60e3 * (middle[1] - middle[0]) / cycle
        still = drift if lpm == 0.0 else still
        size = 1e3 * abs(amplitude_at(opened.t[opened.t >= cycle], opened["x"][opened.t >= cycle], OMEGA / (2 * np.pi)))
        closed = []
        for name in ("pi", "fault-tolerant"):
            run = followed(
                f"position {1e3 * AMPLITUDE} mm sin({OMEGA!r}t)",
                4.0 * cycle,
                controller_of(name, _rig(), lpm),
                lpm,
                "0 N",
            )
            ends = [float(np.mean(run["x"][_cycle_of(run.t, k)])) for k in (2, 3)]
            closed.append(60e3 * (ends[1] - ends[0]) / cycle)
        rows.append((lpm, size, drift, drift - still, *closed))
    heads = (
        "leak [L/min]",
        "open: amplitude [mm]",
        "open: drift [mm/min]",
        "open: drift by the leak [mm/min]",
        "pi: drift [mm/min]",
        "fault-tolerant: drift [mm/min]",
    )
    notes = f"{RIG} under {LOAD:g} N, friction and stiffness off by 20 %. At 0.25 Hz; open: {u:g} V, closed: 40 mm."
    return (ThesisTable(item.id, item.title, heads, tuple(rows), notes=notes),)


def _cycle_of(t: Array, k: int) -> Array:
    cycle = 2.0 * math.pi / OMEGA
    return np.asarray((t >= k * cycle) & (t < (k + 1) * cycle))


def load_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the error on the duty against the load, without a leak and with the middle one."""
    rows: list[tuple[Cell, ...]] = []
    for force in (0.0, 2000.0) if context.quick else (0.0, 500.0, 1000.0, 2000.0):
        beside = f"{force - LOAD!r} N"
        row: list[Cell] = [force]
        for name in ("pi", "flatness", "fault-tolerant"):
            for lpm in (0.0, 0.05):
                error, energy, _ = tracking(name, lpm, beside)
                row += [error, energy]
        rows.append(tuple(row))
    heads = ["load [N]"]
    for name in ("pi", "flatness", "fault-tolerant"):
        for lpm in (0.0, 0.05):
            heads += [f"{name}, {lpm:g} L/min: rms error [mm]", f"{name}, {lpm:g} L/min: energy a cycle [J]"]
    notes = "The leak is a conductance: 0.05 L/min under 2 kN, in proportion less under a smaller load."
    return (ThesisTable(item.id, item.title, tuple(heads), tuple(rows), notes=notes),)


def outside_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate tracking and stiffness where oil leaves the circuit past a rod seal of either side."""
    sound, late = on_duty("pi", 0.0)
    pressure = {side: float(np.mean(sound[f"p_{side}"][late])) for side in ("A", "B")}
    rows: list[tuple[Cell, ...]] = []
    for side, p in pressure.items():
        for name in CONTROLLERS[:1] if context.quick else CONTROLLERS[:4]:
            for lpm in (0.5,) if context.quick else LEAKS[1:]:
                values = {f"G_ext_{side}": lpm / 6e4 / p}
                run, late = on_duty(name, 0.0, values=values)
                lower = np.minimum(run["p_A"], run["p_B"])
                fallen = [1e-3 * float(np.mean(lower[_cycle_of(run.t, k)])) for k in (2, 4)]
                error, flow = _error_and_flow(run, late)
                rows.append((side, name, lpm, error, stiffness(name, 0.0, values=values), flow, fallen[1] - fallen[0]))
    notes = (
        f"{RIG} under {LOAD:g} N, which side A carries ({1e-6 * pressure['A']:.2g} MPa on average, B "
        f"{1e-6 * pressure['B']:.2g}); the leak has its size at that pressure. Friction and stiffness off by 20 %."
    )
    return (ThesisTable(item.id, item.title, OUTSIDE_COLUMNS, tuple(rows), notes=notes),)


def valve_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Tabulate and draw tracking, stiffness and energy of the pump-controlled and the valve-controlled rig."""
    leaks = (0.0, 0.5) if context.quick else LEAKS
    rows: list[tuple[Cell, ...]] = []
    for source, rig in (("pump", RIG), ("valve", VALVE_RIG)):
        for name in VALVE_CONTROLLERS:
            for lpm in leaks:
                error, energy, _ = tracking(name, lpm, rig=rig)
                given, efficiency, taken = energies(name, lpm, rig)
                loop = bandwidth(name, lpm, rig), stiffness(name, lpm, rig)
                rows.append((source, name, lpm, error, *loop, energy, given, 100 * efficiency, 100 * taken))
    notes = (
        f"{RIG} and {VALVE_RIG}: one cylinder, oil, motor and pump, one controller with the same gains, friction and "
        f"stiffness off by 20 %; {1e3 * AMPLITUDE:g} mm at {OMEGA / (2 * math.pi):g} Hz under {LOAD:g} N, efficiencies "
        f"against a damper of {DAMPER:g} N s/m instead. The valve's supply turns at a constant speed; the last column "
        "leaves its losses, motor and pump out. A pump takes energy back on the way down where the load drives it."
    )
    roles: dict[tuple[str, str], Role] = {
        ("pump", "pi"): "simulated",
        ("pump", "flatness"): "25 %",
        ("valve", "pi"): "leak",
        ("valve", "flatness"): "75 %",
    }
    panels = []
    for column in (6, 5):
        curves = []
        for (source, name), role in roles.items():
            own = [row for row in rows if row[:2] == (source, name)]
            x, y = (np.array([float(row[k] or 0.0) for row in own]) for k in (2, column))
            curves.append(FigureCurve(np.maximum(x, 0.001), y, f"{source}, {name}", role))
        panels.append(
            Panel("leak [L/min], none drawn at 0.001", VALVE_COLUMNS[column], tuple(curves), log_x=True, log_y=True)
        )
    table = ThesisTable(item.id, item.title, VALVE_COLUMNS, tuple(rows), notes=notes)
    return table, Figure(f"{item.id}-figure", "Energy and stiffness, pump and valve", tuple(panels), notes=notes)


ITEMS: tuple[Item, ...] = (
    Item("sec-6.2-open-loop", 6, "table", "The piston's drift with a leak: open loop and closed loop", open_loop_table),
    Item("sec-6.2-controllers", 6, "table", "Controllers against the size of the leak", controllers_table),
    Item("sec-6.2-load", 6, "table", "Tracking and energy against the load on the cylinder", load_table),
    Item("sec-6.2-outside", 6, "table", "Controllers against oil that leaves past a rod seal", outside_table),
    Item("sec-6.2-valve", 6, "table", "Pump-controlled against valve-controlled", valve_table),
)
