"""Section 6.2, the thesis's future work: position control with leaks and loads, by the pump and by a servo valve."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.control import Controller, FaultTolerant, controller_named
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Array
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import Trajectory, integrate_run
from sealscope.thesis.chapters.appendix_c_runs import column
from sealscope.thesis.engine.context import Context, first_table
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, Figure, FigureCurve, Panel, Role, ThesisTable
from sealscope.thesis.engine.texts import format_note, judge_claim
from sealscope.thesis.sines import sine_fit
from sealscope.units import LITRE_PER_MINUTE

RIG = "thesis-closed-loop"
#: The valve-controlled rig with the same cylinder, and the controllers with which the two rigs are compared.
VALVE_RIG, VALVE_CONTROLLERS = "servo-valve", ("pi", "flatness")
#: Damper [N s/m] whose work is the useful output of an efficiency: 1.3 kN at the duty's largest speed.
DAMPER = 20e3
#: Parameters of the plant that differ from those the controllers assume: friction +20 %, bulk modulus -20 %.
PLANT_MISMATCH: Mapping[str, float | str] = {"F_pr": 30.0, "F_cfr": 1.2e-6, "F_v": 360.0, "K_oil": 551e6}
#: Load [N] under which a leak passes its stated flow, and the stated flows [L/min].
LOAD, LEAKS = 2000.0, (0.0, 0.0042, 0.05, 0.5)
#: Amplitude [m] and angular frequency [rad/s] of the duty; it needs less than 10 V with the largest leak.
AMPLITUDE, OMEGA = 0.04, 0.5 * math.pi
#: Amplitude [V] of the command in the open loop, which moves the piston by about `AMPLITUDE`.
OPEN_LOOP_U = 7.3
#: Frequency [Hz] and amplitude [N] of the force with which stiffness is measured.
STIFFNESS_FREQUENCY, STIFFNESS_FORCE = 0.5, 500.0
#: Frequencies [Hz] of the sines of the target with which bandwidth is measured, and the amplitude of their speed [m/s].
BANDWIDTH_FREQUENCIES, BANDWIDTH_SPEED = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0), 8e-3
CONTROLLERS = ("pi", "flatness", "fault-tolerant", "fault-tolerant-flatness", "ideal")
#: Controllers that are compared over the load.
LOAD_CONTROLLERS = ("pi", "flatness", "fault-tolerant")
#: Heads of the columns that figures show.
_ERROR, _STIFF, _ENERGY = "rms error [mm]", "stiffness at 0.5 Hz [N/mm]", "electrical energy a cycle [J]"
#: Line style of each curve by the first cells of its rows: the controller, or rig and controller.
_ROLES: dict[tuple[str, ...], Role] = {
    ("pi",): "simulated",
    ("flatness",): "25 %",
    ("fault-tolerant",): "leak",
    ("fault-tolerant-flatness",): "75 %",
    ("ideal",): "reference",
}
_VALVE_ROLES: dict[tuple[str, ...], Role] = {
    ("pump", "pi"): "simulated",
    ("pump", "flatness"): "25 %",
    ("valve", "pi"): "leak",
    ("valve", "flatness"): "75 %",
}
#: Tracking and stiffness count as restored within this fraction of their values without a leak.
RESTORED_FRACTION = 0.1
#: A drift [mm/min] below this limit counts as none.
NEGLIGIBLE_DRIFT = 0.1
#: Two machines or controllers count as different if a quantity differs by more than this factor.
DISTINCT_RATIO = 1.5
#: Period [s] of the duty, and its text as a position target.
CYCLE = 2.0 * math.pi / OMEGA
DUTY = f"position {1e3 * AMPLITUDE} mm sin({OMEGA!r}t)"


def conductance(lpm: float, rig: Rig) -> float:
    """Compute the conductance [m^3/(s Pa)] of a leak that passes `lpm` [L/min] at the pressure difference LOAD/A_A."""
    return lpm * LITRE_PER_MINUTE / (LOAD / rig.cylinder.A_A)


def _amplitude_at(run: Trajectory, mask: NDArray[np.bool_], f: float) -> float:
    """Compute the amplitude [m] of the piston's motion at the frequency `f` [Hz], from the samples in `mask`."""
    return float(np.abs(sine_fit(run.t[mask], run["x"][mask], 2 * math.pi * f).amplitudes[0]))


def supply_flow(run: Trajectory) -> Array:
    """Compute the flow [m^3/s] (n,) from the supply of a servo valve: Q_A into A for x_s > 0, else -Q_B into B."""
    return np.asarray(np.where(run["x_s"] > 0.0, run["Q_A"], -run["Q_B"]))


@dataclass(frozen=True)
class ControlledRig:
    """A rig whose piston a controller positions, with a leak that passes `lpm` [L/min] under a load of 2 kN (`LOAD`).

    The rig's friction and bulk modulus differ from those that the controller assumes (`PLANT_MISMATCH`). `controller`:
    its name, "" for none (open loop), "ideal" for a fault-tolerant one that knows the leak; `values`: parameters that
    override the rig's, as pairs (name, value in SI units).
    """

    controller: str
    lpm: float
    rig: str = RIG
    values: tuple[tuple[str, float], ...] = ()

    def run(self, command: str, duration: float, load: str = "0 N") -> Trajectory:
        """Simulate the rig for `duration` [s] under the load `LOAD` plus `load`, the text of a force against +x.

        An "F_l" in `values` replaces `LOAD`. `command`: text of a position target or, in an open loop, a voltage.
        """
        rig = load_rig(self.rig)
        leak_conductance = conductance(self.lpm, rig)
        if self.controller == "ideal":
            controller: Controller | None = FaultTolerant.from_rig(rig, known=leak_conductance)
        else:
            controller = controller_named(self.controller, rig) if self.controller else None
        experiment = Experiment.of(
            rig=rig,
            set={**PLANT_MISMATCH, "F_l": LOAD, **dict(self.values)},  # the controller assumes the rig without these
            command=command,
            duration=duration,
            controller=controller,
            leak=f"G = {leak_conductance!r}" if self.lpm else None,
            load=load,
        )
        return integrate_run(experiment, experiment.leaks)

    def run_duty(self, load: str = "0 N") -> tuple[Trajectory, Array]:
        """Simulate five cycles of the position sine `DUTY`; return the run and the mask of its last two cycles."""
        run = self.run(DUTY, 5.0 * CYCLE, load)
        return run, np.asarray((run.t >= 3.0 * CYCLE) & (run.t < 5.0 * CYCLE))

    def stiffness(self) -> float:
        """Compute the stiffness |F/x| [N/mm] at a constant target, from the motion under a sine of the force F."""
        force = f"{STIFFNESS_FORCE} N sin({2 * math.pi * STIFFNESS_FREQUENCY!r}t)"
        run = self.run("position 0 mm sin(t)", duration=16.0, load=force)  # amplitude 0: a constant target
        is_settled = run.t >= 8.0  # [s]
        return STIFFNESS_FORCE / (1e3 * _amplitude_at(run, is_settled, STIFFNESS_FREQUENCY))

    def bandwidth(self) -> float:
        """Compute the frequency [Hz] at which the tracking error of small sines first exceeds -3 dB of the target.

        The error is |x/target - 1| of complex amplitudes at `BANDWIDTH_FREQUENCIES`, between which the result is
        interpolated. Returns the lowest frequency if the error is larger there already, and inf if it never is.
        """
        frequencies = BANDWIDTH_FREQUENCIES
        terms = [f"{1e3 * BANDWIDTH_SPEED / (2 * math.pi * f):.6f} mm sin({2 * math.pi * f!r}t)" for f in frequencies]
        run = self.run(f"position {' + '.join(terms)}", 14.0)
        is_settled = run.t >= 8.0
        omegas = 2 * np.pi * np.array(frequencies)
        target = -1j * BANDWIDTH_SPEED / omegas  # complex amplitudes a of Re(a exp(i omega t))
        error = np.abs(sine_fit(run.t[is_settled], run["x"][is_settled], *omegas).amplitudes / target - 1.0)
        limit = math.sqrt(0.5)  # -3 dB
        exceeding = np.flatnonzero(error > limit)
        if exceeding.size == 0:
            return math.inf
        # interpolated on a logarithmic axis of frequency, between the first larger error and the one before, if any
        around = slice(max(0, int(exceeding[0]) - 1), int(exceeding[0]) + 1)
        return float(np.exp(np.interp(limit, error[around], np.log(frequencies[around]))))

    def efficiencies(self) -> tuple[float, float]:
        """Compute the electrical and the hydraulic efficiency of a sine motion against a damper as the only load.

        These are the work in the damper over the motor's electrical energy, and over the hydraulic energy from the pump
        at its ports or, in a valve-controlled rig, from a lossless supply at the supply's pressure.
        """
        run, mask = replace(self, values=(("F_l", 0.0), ("d_load", DAMPER))).run_duty()
        flow = supply_flow(run) if load_rig(self.rig).circuit.valve_controlled else run["Q_1"]
        damper_power = DAMPER * float(np.mean(run["v"][mask] ** 2))
        electrical_power = float(np.mean((run["V"] * run["i"])[mask]))
        hydraulic_power = float(np.mean((flow * (run["p_1"] - run["p_2"]))[mask]))
        return damper_power / electrical_power, damper_power / hydraulic_power


def tracking(run: Trajectory, mask: Array) -> tuple[float, float, float]:
    """Compute how the piston follows the position sine `DUTY` in the samples `mask` of whole cycles.

    Returns rms error [mm], electrical energy in a cycle [J], and mean leakage that the controller compensates [L/min],
    0 if it compensates none.
    """
    error = AMPLITUDE * np.sin(OMEGA * run.t[mask]) - run["x"][mask]
    flow = 0.0 if run.compensated is None else float(np.mean(run.compensated[mask])) / LITRE_PER_MINUTE
    energy = float(np.mean(run["V"][mask] * run["i"][mask])) * CYCLE
    return 1e3 * float(np.sqrt(np.mean(error**2))), energy, flow


def controllers_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Tabulate the performance of each controller with each leak; plot error and stiffness over the leak."""
    rows: list[tuple[Cell, ...]] = []
    for name, lpm in itertools.product(CONTROLLERS, _leak_flows(context)):
        loop = ControlledRig(name, lpm)
        error, energy, flow = tracking(*loop.run_duty())
        rows.append((name, lpm, error, loop.bandwidth(), energy, loop.stiffness(), flow))
    notes = format_note("controllers", rig=RIG, load=LOAD, mm=1e3 * AMPLITUDE, f=1 / CYCLE)
    table = item.table(rows, notes)
    return table, _figure_over_leak(table, "Error and stiffness against the leak", _ROLES, (_ERROR, _STIFF))


def _leak_flows(context: Context) -> tuple[float, ...]:
    """Return the leaks [L/min under a load of 2 kN] to simulate, fewer of them in a quick reproduction."""
    return (0.0, 0.5) if context.quick else LEAKS


def _figure_over_leak(
    table: ThesisTable, title: str, roles: Mapping[tuple[str, ...], Role], columns: Sequence[str], log_y: bool = False
) -> Figure:
    """Draw some `columns` of a table over the leak, one panel each.

    `roles`: line style of each curve, by the first cells of its rows. A leak of 0 is drawn at 0.001 L/min.
    """
    panels = []
    for head in columns:
        curves = []
        for names, role in roles.items():
            leak, y = map(np.array, zip(*_column_by_leak(table, names, head).items(), strict=True))
            leak = np.maximum(leak, 0.001)  # a logarithmic axis has no 0
            curves.append(FigureCurve(leak, y, ", ".join(names), role))
        panels.append(Panel("leak [L/min], none drawn at 0.001", head, tuple(curves), log_x=True, log_y=log_y))
    return Figure(f"{table.id}-figure", title, tuple(panels), notes=table.notes)


def open_loop_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the drift of the piston's mean position by leak, without a controller and with two of them."""
    rows: list[tuple[Cell, ...]] = []
    healthy_drift = 0.0

    def drift(run: Trajectory, first: int) -> float:
        """Compute the drift of the piston's mean position [mm/min] from cycle `first` of a run to the next cycle."""
        means = [float(np.mean(run["x"][_cycle_mask(run.t, k)])) for k in (first, first + 1)]
        return 60e3 * (means[1] - means[0]) / CYCLE  # 60e3 mm/min are 1 m/s

    for lpm in _leak_flows(context):
        # a cosine of the speed makes the position swing about its start; drifts are between a run's last two cycles
        open_loop = ControlledRig("", lpm).run(f"{OPEN_LOOP_U} sin({OMEGA!r}t + {0.5 * math.pi!r})", 3.0 * CYCLE)
        open_drift = drift(open_loop, first=1)
        if lpm == 0.0:  # the first of the leaks
            healthy_drift = open_drift
        is_settled = open_loop.t >= CYCLE
        amplitude_mm = 1e3 * _amplitude_at(open_loop, is_settled, 1 / CYCLE)
        closed = [drift(ControlledRig(name, lpm).run(DUTY, 4.0 * CYCLE), first=2) for name in ("pi", "fault-tolerant")]
        rows.append((lpm, amplitude_mm, open_drift, open_drift - healthy_drift, *closed))
    return (item.table(rows, format_note("open-loop", rig=RIG, load=LOAD, u=OPEN_LOOP_U)),)


def _cycle_mask(t: Array, k: int) -> Array:
    """Return the mask of the samples at times `t` [s] in cycle `k`, counted from 0, of the position sine `DUTY`."""
    return np.asarray((t >= k * CYCLE) & (t < (k + 1) * CYCLE))


def load_head(controller: str, lpm: float, quantity: str) -> str:
    """Build the head of a column of `load_table`, which states controller, leak [L/min] and quantity."""
    return f"{controller}, {lpm:g} L/min: {quantity}"


def load_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate tracking error and energy over the load, for three controllers without and with a leak."""
    loops = [ControlledRig(name, lpm) for name in LOAD_CONTROLLERS for lpm in (0.0, 0.05)]
    heads = ["load [N]"]
    for loop in loops:
        heads += [load_head(loop.controller, loop.lpm, quantity) for quantity in (_ERROR, "energy a cycle [J]")]
    rows = []
    for force in (0.0, 2000.0) if context.quick else (0.0, 500.0, 1000.0, 2000.0):
        further_load = f"{force - LOAD!r} N"  # added to `LOAD`, which acts in every run
        pairs = (tracking(*loop.run_duty(further_load))[:2] for loop in loops)  # error and energy
        rows.append((force, *itertools.chain.from_iterable(pairs)))
    return (item.table(rows, format_note("load"), heads),)


def external_leak_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate tracking and stiffness of each controller with a leak past the rod seal of either side.

    The last column [kPa] shows the loss of oil: the change of the lower chamber pressure's mean from the third to the
    fifth cycle. The flow of a leak is stated for the mean pressure on its side in a run without leaks.
    """
    healthy, mask = ControlledRig("pi", 0.0).run_duty()
    mean_pressure = {side: float(np.mean(healthy[f"p_{side}"][mask])) for side in ("A", "B")}
    # the controller "ideal" is left out, as only internal leaks are made known to it
    names, leaks = (("pi",), (0.5,)) if context.quick else (CONTROLLERS[:-1], LEAKS[1:])
    rows: list[tuple[Cell, ...]] = []
    for side, name, lpm in itertools.product(mean_pressure, names, leaks):
        loop = ControlledRig(name, 0.0, values=((f"G_ext_{side}", lpm * LITRE_PER_MINUTE / mean_pressure[side]),))
        run, mask = loop.run_duty()
        lower_pressure = np.minimum(run["p_A"], run["p_B"])
        third_cycle, fifth_cycle = (1e-3 * float(np.mean(lower_pressure[_cycle_mask(run.t, k)])) for k in (2, 4))
        error, _, flow = tracking(run, mask)
        rows.append((side, name, lpm, error, loop.stiffness(), flow, fifth_cycle - third_cycle))
    notes = format_note("outside", rig=RIG, load=LOAD, A=1e-6 * mean_pressure["A"], B=1e-6 * mean_pressure["B"])
    return (item.table(rows, notes),)


def valve_table(context: Context, item: Item) -> tuple[ThesisTable | Figure, ...]:
    """Compare a pump- and a valve-controlled rig by controller and leak in a table; plot their energy and stiffness."""
    rigs = {"pump": RIG, "valve": VALVE_RIG}
    rows: list[tuple[Cell, ...]] = []
    for (source, rig), name, lpm in itertools.product(rigs.items(), VALVE_CONTROLLERS, _leak_flows(context)):
        loop = ControlledRig(name, lpm, rig)
        run, mask = loop.run_duty()
        error, energy, _ = tracking(run, mask)
        # hydraulic energy at the pump's ports in a cycle [J]
        pump_energy = float(np.mean((run["Q_1"] * (run["p_1"] - run["p_2"]))[mask])) * CYCLE
        efficiencies = [100 * efficiency for efficiency in loop.efficiencies()]
        rows.append((source, name, lpm, error, loop.bandwidth(), loop.stiffness(), energy, pump_energy, *efficiencies))
    notes = format_note("valve", rig=RIG, other=VALVE_RIG, mm=1e3 * AMPLITUDE, f=1 / CYCLE, load=LOAD, damper=DAMPER)
    table = item.table(rows, notes)
    title = "Energy and stiffness, pump and valve"
    return table, _figure_over_leak(table, title, _VALVE_ROLES, (_ENERGY, _STIFF), log_y=True)


def _column_by_leak(table: ThesisTable, names: tuple[str, ...], head: str) -> dict[float, float]:
    """Return the column `head` of a table by the leak [L/min], from rows that begin with `names`, then the leak."""
    rows = [row[: len(names)] == names for row in table.rows]
    leaks = column(table, table.columns[len(names)])
    return dict(zip(leaks[rows].tolist(), column(table, head)[rows].tolist(), strict=True))


def judge_claims(context: Context, item: Item) -> tuple[Claim, ...]:
    """Judge claims 6.2.1 to 6.2.4 on position control; `item` is not used."""
    return _disturbance_claim(context), _tolerance_claim(context), _load_claim(context), _valve_claim(context)


def _disturbance_claim(context: Context) -> Claim:
    """Judge claim 6.2.1, that position feedback suppresses disturbances: with the PI controller no leak makes drift."""
    table = first_table(context, "sec-6.2-open-loop")
    heads = "leak [L/min]", "open: drift by the leak [mm/min]", "pi: drift [mm/min]"
    rows = [row for row in zip(*(column(table, head) for head in heads), strict=True) if row[0] > 0]  # with a leak
    texts = [f"{lpm:g} L/min: {open_drift:.1f} open, {pi_drift:.2f} closed" for lpm, open_drift, pi_drift in rows]
    tests = [abs(pi_drift) < NEGLIGIBLE_DRIFT for *_, pi_drift in rows]
    return judge_claim("6.2.1", tests, drifts="; ".join(texts))


def _tolerance_claim(context: Context) -> Claim:
    """Judge claim 6.2.2: a fault-tolerant controller restores tracking and stiffness with a leak.

    With each leak, the tracking error may be at most 10 % larger, and the stiffness at most 10 % smaller, than with the
    PI controller and no leak. Without a leak its error must equal that of the PI controller, with no flow compensated.
    """
    table = first_table(context, "sec-6.2-controllers")
    error, tolerant_error = (_column_by_leak(table, (name,), _ERROR) for name in ("pi", "fault-tolerant"))
    stiffness, tolerant_stiffness = (_column_by_leak(table, (name,), _STIFF) for name in ("pi", "fault-tolerant"))
    compensated = _column_by_leak(table, ("fault-tolerant",), "made good [L/min]")
    tests, texts = [], []
    for lpm in sorted(lpm for lpm in error if lpm > 0):
        tests.append(tolerant_error[lpm] <= (1 + RESTORED_FRACTION) * error[0.0])
        tests.append(tolerant_stiffness[lpm] >= (1 - RESTORED_FRACTION) * stiffness[0.0])
        errors = f"{error[lpm]:.3f} and {tolerant_error[lpm]:.3f} mm"
        texts.append(f"{lpm:g} L/min: {errors}, {stiffness[lpm]:.0f} and {tolerant_stiffness[lpm]:.0f} N/mm")
    same_if_healthy = tolerant_error[0.0] == error[0.0] and compensated[0.0] == 0.0
    healthy = {"error": error[0.0], "stiffness": stiffness[0.0], "unless": "" if same_if_healthy else " NOT"}
    return judge_claim("6.2.2", [*tests, same_if_healthy], pairs="; ".join(texts), **healthy)


def _load_claim(context: Context) -> Claim:
    """Judge claim 6.2.3: without a leak, the largest error over the loads differs distinctly between controllers."""
    table = first_table(context, "sec-6.2-load")
    error_ranges = {}
    for name in LOAD_CONTROLLERS:
        errors = column(table, load_head(name, lpm=0.0, quantity=_ERROR))
        error_ranges[name] = float(errors.min()), float(errors.max())
    max_low = max(low for low, _ in error_ranges.values())
    highs = [high for _, high in error_ranges.values()]
    text = "; ".join(f"{name} {low:.3f} to {high:.3f} mm" for name, (low, high) in error_ranges.items())
    tests = [max(highs) > DISTINCT_RATIO * min(highs)]
    all_below_one_percent = max(highs) < 0.01 * 1e3 * AMPLITUDE  # 1 % of the duty's amplitude [mm]
    return judge_claim("6.2.3", tests, spread=text, all_below=all_below_one_percent, largest_low=max_low)


def _valve_claim(context: Context) -> Claim:
    """Judge claim 6.2.4: with PI and no leak, pump and valve differ distinctly in efficiency and tracking error."""
    table = first_table(context, "sec-6.2-valve")
    tests = []
    for head in ("efficiency against a damper [%]", _ERROR):
        pair = [_column_by_leak(table, (source, "pi"), head)[0.0] for source in ("pump", "valve")]
        tests.append(max(pair) > DISTINCT_RATIO * min(pair))
    # by rig and leak: the cells of the columns after the leak
    numbers = {(source, lpm): values for source, name, lpm, *values in table.rows if name == "pi"}
    max_leak = max(float(lpm or 0.0) for _, lpm in numbers)
    pump, valve = numbers["pump", 0.0], numbers["valve", 0.0]
    worn = [numbers["pump", max_leak], numbers["valve", max_leak]]
    return judge_claim("6.2.4", tests, pump=pump, valve=valve, largest=max_leak, worn=worn)
