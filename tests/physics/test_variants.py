"""Oil and energy of every variant of the rig: nothing appears, nothing is lost, whatever its numbers are.

Flows, losses and stored energies are written out here from the states of a run.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson, simpson
from scipy.interpolate import CubicSpline

from sealscope.errors import SimulationFailed
from sealscope.parameters import load_rig
from sealscope.units import P_ATM

STEP, DURATION = 1e-5, 0.6


def within(**values):
    """Parameters of a rig: a range of numbers each, or a list of words."""
    kinds = {name: st.sampled_from(of) if isinstance(of, list) else st.floats(*of) for name, of in values.items()}
    return st.fixed_dictionaries(kinds)


MACHINE = {"M_eq": (8.0, 20.0), "K_oil": (5e8, 1.2e9), "F_pr": (5.0, 40.0), "K_brk": (1.0, 3.5), "F_v": (200.0, 500.0)}
LOADED = {"F_l": (-60.0, 60.0), "k_load": (0.0, 3e3)}
LINES = {"closed_A": (0.0, 0.8), "closed_B": (0.0, 0.8), "V_1": (2e-5, 1e-4), "metering": ["meter-out", "literal"]}
#: Rig, what it always has, and what is drawn.
VARIANTS = {
    "free": ("thesis", {}, {**MACHINE, **LOADED, "G_pump": (0.0, 1e-12)}),
    "throttled": ("thesis", {"orifices": "present"}, {**MACHINE, **LOADED, **LINES, "G_pump": (0.0, 1e-12)}),
    "made up": (
        "thesis",
        {"check_valves": "present"},
        {**MACHINE, "G_ext_A": (1e-13, 1e-11), "G_ext_B": (1e-13, 1e-11), "V_gas": (1e-4, 1e-3)},
    ),
    "single rod": (
        "single-rod-eha",
        {"volumes": "fixed"},
        {
            **{"F_l": (-3e3, 3e3), "k_load": (0.0, 3e3), "d_load": (10.0, 800.0), "p_charge": (3e5, 8e5)},
            **{"p_relief": (1e5, 2e6), "G_pump": (0.0, 1e-12), "k_pilot": (1.5, 5.0), "n_gas": (1.05, 1.4)},
        },
    ),
    "servo valve": (
        "servo-valve",
        {"volumes": "fixed"},
        {
            **MACHINE,
            **{"F_l": (-1e3, 1e3), "k_load": (0.0, 4e3), "d_load": (10.0, 500.0), "G_pump": (0.0, 1e-12)},
            **{name: (-2e-5, 2e-5) for name in ("o_PA", "o_AT", "o_PB", "o_BT")},
            **{"p_set": (5.5e6, 8e6), "n_acc": (1.0, 1.4), "Q_N": (1e-4, 2e-4)},
        },
    ),
    "lines, losses and an opposing cylinder": (
        "thesis",
        {"orifices": "present", "p_charge": "2 MPa", "A_opp": "100[mm^2]"},
        {
            **MACHINE,
            **LINES,
            **{"T_f": (0.01, 0.2), "C_f": (0.0, 0.05), "C_h": (0.0, 100.0), "C_st": (0.0, 5e-5), "B_M": (1e-4, 1e-3)},
            **{"R_A": (1e8, 1e10), "R_B": (1e8, 1e10), "open_B": (0.2, 1.0), "p_opp": (0.0, 2e6)},
            **{
                "k_clog_A": (1.0, 1e6),
                "n_clog": [0.0, 1.0, 1.5, 2.0],
                "p_bypass": (1e4, 1e5),
                "G_bypass": (1e-11, 1e-9),
            },
        },
    ),
}


class Account:
    """Flows [m^3/s] and powers [W] of a run, from its states."""

    def __init__(self, rig, run, G: float, C: float) -> None:
        self.rig, self.run, self.G, self.C = rig, run, G, C
        self.p_A, self.p_B, self.p_1, self.p_2 = (run[name] for name in ("p_A", "p_B", "p_1", "p_2"))
        self.throttled = rig.line.orifices == "present"
        self.valved = rig.circuit.valve_controlled
        self.port_1, self.port_2 = (self.p_1, self.p_2) if self.throttled else (self.p_A, self.p_B)
        self.D = rig.pump.q_b / (2 * math.pi)
        self.over_pump = self.p_1 - self.p_2
        slip = rig.pump.C_st * self.D ** (2 / 3) * math.sqrt(2 / rig.fluid.rho) * self.over_pump
        self.lost_in_pump = slip / (self.over_pump**2 + rig.line.dp_0**2) ** 0.25 + rig.pump.G_pump * self.over_pump

    def total(self, power: np.ndarray) -> float:
        return float(simpson(power, x=self.run.t))

    @property
    def supply(self) -> np.ndarray:
        """Pressure [Pa] of the make-up's accumulator."""
        m = self.rig.makeup
        return (self.rig.fluid.p_charge + P_ATM) * (m.V_gas / (m.V_gas + self.run["V_up"])) ** m.n_gas - P_ATM

    def made_up(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Flow through each valve of the make-up, and the pressure difference that drives it."""
        m, supply, sides = self.rig.makeup, self.supply, (self.port_1, self.port_2)
        valves = {}
        for name, side, other in zip("12", sides, sides[::-1], strict=True):
            if m.check_valves == "pilot-operated":
                lifted = (supply - side + m.k_pilot * np.maximum(other - supply, 0.0) - m.p_crack) / m.p_open
                up = m.G_check * (supply - side) * np.clip(lifted, 0.0, 1.0)
            else:
                up = m.G_check * np.maximum(supply - side - m.p_crack, 0.0)
            valves[f"check valve {name}"] = up, supply - side
            valves[f"relief valve {name}"] = m.G_relief * np.maximum(side - supply - m.p_relief, 0.0), side - supply
        return valves

    def edges(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Flow through the servo valve's edges and the supply's relief valve, and the difference that drives each."""
        v, s, x = self.rig.valve, self.rig.supply, self.run["x_s"]

        def edge(dp, way, overlap):
            c = v.Q_N / math.sqrt(v.dp_N) * np.maximum(way - overlap, 0.0) / v.x_max
            return c * dp / (dp**2 + v.dp_lam**2) ** 0.25, dp

        return {
            "PA": edge(self.p_1 - self.p_A, x, v.o_PA),
            "AT": edge(self.p_A - self.p_2, -x, v.o_AT),
            "PB": edge(self.p_1 - self.p_B, -x, v.o_PB),
            "BT": edge(self.p_B - self.p_2, x, v.o_BT),
            "relief": (s.G_set * np.maximum(self.over_pump - s.p_set, 0.0), self.over_pump),
        }

    def in_supply(self, weight) -> np.ndarray:
        """Integral of weight(p) times the compliance of line and accumulator over the supply's pressure."""
        s, K = self.rig.supply, self.rig.fluid.K_oil
        p = np.linspace(self.p_1.min() - 1.0, self.p_1.max() + 1.0, 4001)
        gas = s.V_acc * ((s.p_pre + P_ATM) / (np.maximum(p, s.p_pre) + P_ATM)) ** (1.0 / s.n_acc)
        room = (self.rig.line.V_1 + s.V_acc - gas) / K + gas / (s.n_acc * (p + P_ATM))
        table = CubicSpline(p, weight(p) * room).antiderivative()
        return table(self.p_1) - table(self.p_1[0])

    def missing_oil(self) -> np.ndarray:
        """Oil [m^3] that the circuit holds beyond what it held at first and what came in since, over the run."""
        c, line, run = self.rig.cylinder, self.rig.line, self.run
        held = c.V * self.p_A + (c.V - c.V_rod) * self.p_B
        if self.throttled:
            held = held + line.V_1 * self.p_1 + line.V_2 * self.p_2
        held = held / self.rig.fluid.K_oil + (c.A_A - c.A_B) * run["x"] - run["V_up"]
        out = c.G_ext_A * np.maximum(self.p_A, 0.0) + c.G_ext_B * np.maximum(self.p_B, 0.0)
        if self.valved:
            Q = {name: flow for name, (flow, _) in self.edges().items()}
            held = held + self.in_supply(np.ones_like)
            out = out + Q["AT"] + Q["BT"] + Q["relief"] + self.lost_in_pump - self.D * run["omega"]
        return np.asarray(held - held[0] + cumulative_simpson(out, x=run.t, initial=0.0))

    def energies(self) -> dict[str, float]:
        """Energies [J]: what came in through the wires, what each place lost, what is stored more than at first."""
        rig, run, total = self.rig, self.run, self.total
        m, c, f, line, K = rig.motor, rig.cylinder, rig.friction, rig.line, rig.fluid.K_oil
        omega, v = run["omega"], run["v"]
        speed, dp = np.abs(v), self.p_A - self.p_B
        F_C = f.F_pr + f.F_cfr * (self.p_A + self.p_B)
        running = F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * speed)) + f.F_v * speed
        standing = speed / f.v_th * (F_C * (1 + (f.K_brk - 1) * np.exp(-f.C_c * f.v_th)) + f.F_v * f.v_th)
        rubbing = np.clip(np.abs(omega) / m.omega_f, 0, 1) * (m.T_f + rig.pump.C_f * self.D * np.abs(self.over_pump))
        drag = 0.5 * rig.pump.C_h * rig.fluid.rho * self.D ** (5 / 3) * omega**2
        against = c.F_l * v + c.d_load * v**2
        if c.A_opp > 0:
            against = against + v * c.A_opp * (c.p_opp + v * speed * (c.A_opp / c.C_opp) ** 2)

        def gained(energy: np.ndarray) -> float:
            return float(energy[-1] - energy[0])

        terms = {
            "wires": total(run["V"] * run["i"]),
            "copper": total(m.R_c * run["i"] ** 2),
            "motor and pump": total((m.B_M * np.abs(omega) + rubbing + drag) * np.abs(omega)),
            "past the pump": total(self.lost_in_pump * self.over_pump),
            "past the piston": total(dp * (self.G * dp + self.C * dp / (dp**2 + line.dp_0**2) ** 0.25)),
            "past the rod seals": total(c.G_ext_A * self.p_A**2 + c.G_ext_B * self.p_B**2),
            "friction": total(np.where(speed > f.v_th, running, standing) * speed),
            "load": total(against),
            "spring": gained(0.5 * c.k_load * run["x"] ** 2),
            "winding": gained(0.5 * m.L_c * run["i"] ** 2),
            "rotor": gained(0.5 * m.J_M * omega**2),
            "piston": gained(0.5 * c.M_eq * v**2),
            "oil": gained(0.5 * (c.V * self.p_A**2 + (c.V - c.V_rod) * self.p_B**2) / K),
        }
        if self.throttled:
            terms["lines"] = total(run["Q_A"] * (self.p_1 - self.p_A) + run["Q_B"] * (self.p_B - self.p_2))
            terms["oil of the lines"] = gained(0.5 * (line.V_1 * self.p_1**2 + line.V_2 * self.p_2**2) / K)
        if rig.makeup.check_valves != "absent":
            terms |= {name: total(flow * over) for name, (flow, over) in self.made_up().items()}
            gas, n = rig.makeup.V_gas + run["V_up"], rig.makeup.n_gas
            work = (rig.fluid.p_charge + P_ATM) * rig.makeup.V_gas * np.log(gas) if n == 1.0 else None
            inside = -work if n == 1.0 else (self.supply + P_ATM) * gas / (n - 1.0)
            terms["gas"] = gained(inside + P_ATM * gas)
        if self.valved:
            edges = self.edges()
            back = edges["AT"][0] + edges["BT"][0] + edges["relief"][0] - run["Q_1"]
            terms |= {f"edge {name}": total(flow * over) for name, (flow, over) in edges.items()}
            terms["return"] = total(self.p_2 * back)
            terms["supply"] = float(self.in_supply(lambda p: p)[-1])
        return terms


def examples(default: int, slow: int):
    """Few examples of a property in the default tests, more in the long ones."""
    return pytest.mark.parametrize(
        "count",
        [pytest.param(default, id="few"), pytest.param(slow, id="many", marks=[pytest.mark.slow, pytest.mark.long])],
    )


#: Compiled of its own, and long.
LONG = ("lines, losses and an opposing cylinder", "servo valve", "single rod")


@pytest.mark.parametrize(
    "variant", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in VARIANTS]
)
@examples(3, 8)
def test_nothing_is_lost(drive, variant, count):
    """Oil to 1e-9 of what the pump moves, energy to 2e-6 of what is turned over: relief valves open with a kink."""
    name, fixed, drawn = VARIANTS[variant]

    @settings(max_examples=count, deadline=None, suppress_health_check=list(HealthCheck))
    @given(
        values=within(**drawn),
        leak=st.tuples(st.floats(0.0, 5e-12), st.floats(0.0, 1e-9)),
        wave=st.tuples(st.floats(1.0, 5.0), st.floats(4.0, 12.0), st.floats(0.0, 6.0)),
    )
    def keeps(values, leak, wave):
        rig = load_rig(name).with_overrides({**fixed, **values})
        assert rig.cylinder.volumes == "fixed"
        assert rig.motor.C_e == rig.motor.C_m  # else the motor itself makes or eats energy
        volts, omega, phase = wave
        try:
            run = drive(
                rig,
                DURATION + STEP,
                u=lambda t: volts * (np.sin(omega * t + phase) - np.sin(phase)),
                G=leak[0],
                C=leak[1],
                rate=1 / STEP,
                step=STEP,
            )
        except SimulationFailed:  # a chamber reaches vacuum: no machine of the model
            reject()
        account = Account(rig, run, *leak)
        moved = account.total(np.abs(run["Q_1"]))
        assert np.abs(account.missing_oil()).max() <= 1e-9 * moved
        terms = account.energies()
        came = terms.pop("wires")
        assert sum(terms.values()) == pytest.approx(came, abs=2e-6 * sum(map(abs, terms.values()))), terms

    keeps()
