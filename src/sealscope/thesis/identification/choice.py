"""What is fitted to Appendix C and within which bounds: the choices behind the rig `thesis-calibrated`."""

from __future__ import annotations

from sealscope.thesis.identification.search import Free

#: Sampling rates tried [Hz].
RATES = (1000.0, 500.0, 200.0, 100.0)
#: Settings that all trials share and that were not fitted, but chosen among few (`docs/decisions/0006-calibration.md`).
COMMON: dict[str, float | str] = {"line.orifices": "present"}
#: The free parameters. K_oil from very aerated to clean oil; the speed per volt up to what keeps 8 sin(t) inside the
#: stroke from a start at its middle; friction and speed loop as printed, within a factor of 2 to 10.
FREE: tuple[Free, ...] = (
    Free(("fluid.K_oil",), 430e6, 50e6, 900e6),
    Free(("motor.omega_per_volt",), 12.5, 5.0, 20.0),
    Free(("line.V_1", "line.V_2"), 35e-6, 5e-6, 300e-6),
    Free(("friction.K_brk",), 2.4, 1.2, 5.0),
    Free(("friction.F_v",), 230.0, 100.0, 600.0),
    Free(("friction.v_th",), 2e-3, 5e-4, 1.5e-2),
    Free(("motor.k_p",), 7.0, 1.0, 12.0),
)
