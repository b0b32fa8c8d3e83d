"""The oil: the air in it, and what its temperature changes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import contracted
from sealscope.physics.lanes import anywhere, exponential
from sealscope.units import P_ATM

#: 40 and 100 deg C [K], at which viscosities are stated.
_T_40, _T_100 = 313.15, 373.15
#: Relative change of the bulk modulus of mineral oils with temperature, as a power of ten [1/K].
_SOFTER = 0.0024
#: Least absolute pressure [Pa] at which the law of the air is evaluated: a bubble has a volume.
_LEAST = 100.0


@contracted
def effective_bulk_modulus(p: float, K_oil: float, air: float, n_air: float) -> float:
    """Compute the bulk modulus [Pa] of oil with free air at the pressure `p` [Pa gauge].

    K = K_oil (1 + r)/(1 + r K_oil/(n p_abs)), r = air (p_atm/p_abs)^(1/n): volume of air over volume of oil, compressed
    polytropically from its share `air` at atmospheric pressure; nothing dissolves. K_oil without air, exactly.

    Source: H. E. Merritt, Hydraulic Control Systems, 1967, effective bulk modulus (1/K is the sum of the compliances of
    liquid and gas); in this form the hydraulic fluid of the Simscape library, from which the thesis took its friction.
    """
    if not anywhere(air > 0.0):
        return K_oil + 0.0 * p
    p_abs = max(p + P_ATM, _LEAST)
    r = air_share(p, air, n_air)
    return K_oil * (1.0 + r) / (1.0 + r * K_oil / (n_air * p_abs))


@contracted
def oil_density_ratio(dp: float, K_oil: float) -> float:
    """Compute rho(p + dp)/rho(p) = exp(dp/K_oil) of oil without air and with a constant bulk modulus.

    From K = rho dp/d rho (Merritt, Hydraulic Control Systems, 1967, the definition of the bulk modulus).
    """
    return exponential(dp / K_oil)  # type: ignore[no-any-return]


@contracted
def air_share(p: float, air: float, n_air: float) -> float:
    """Compute the volume of air over volume of oil at `p` [Pa gauge]: air (p_atm/p_abs)^(1/n)."""
    return air * math.pow(P_ATM / max(p + P_ATM, _LEAST), 1.0 / n_air)


@contracted
def mixture_density_ratio(p: float, p_0: float, K_oil: float, air: float, n_air: float) -> float:
    """Return rho(p)/rho(p_0) of oil with free air, whose modulus is `effective_bulk_modulus`.

    ln of it is the integral of dp/K: ln((1 + r_0)/(1 + r)) of the air exactly, and that of dp/(K_oil (1 + r)) by
    Simpson's rule, whose error is far below r dp/K_oil.
    """
    r, r_0, r_m = air_share(p, air, n_air), air_share(p_0, air, n_air), air_share(0.5 * (p + p_0), air, n_air)
    mean = (1.0 / (1.0 + r) + 4.0 / (1.0 + r_m) + 1.0 / (1.0 + r_0)) / 6.0
    return (1.0 + r_0) / (1.0 + r) * exponential((p - p_0) * mean / K_oil)  # type: ignore[no-any-return]


def kinematic_viscosity(T: NDArray[np.float64], nu_40: float, nu_100: float) -> NDArray[np.float64]:
    """Compute the kinematic viscosity [m^2/s] of an oil at the temperatures T [K], from those at 40 and 100 deg C.

    log log(nu + 0.7) = A - B log T, nu in mm^2/s: Walther's law, ASTM D341 (above 2 mm^2/s).
    """
    y_40, y_100 = (math.log(math.log(1e6 * nu + 0.7)) for nu in (nu_40, nu_100))
    B = (y_40 - y_100) / math.log(_T_100 / _T_40)
    return np.asarray(1e-6 * (np.exp(np.exp(y_40 - B * np.log(T / _T_40))) - 0.7))


def thermal_density(T: NDArray[np.float64], T_0: float, alpha: float) -> NDArray[np.float64]:
    """Compute the density at the temperatures T [K] over that at T_0 [K]: 1 - alpha (T - T_0).

    Source: Merritt, Hydraulic Control Systems, 1967, section 2.2, density of petroleum fluids; `alpha` [1/K].
    """
    return np.asarray(1.0 - alpha * (T - T_0))


def thermal_stiffness(T: NDArray[np.float64], T_0: float) -> NDArray[np.float64]:
    """Compute the bulk modulus at the temperatures T [K] over that at T_0 [K]: 10^(-0.0024 (T - T_0)), of mineral oils.

    Source: A. T. J. Hayward, How to estimate the bulk modulus of hydraulic fluids, Hydraulic Pneumatic Power 16 (1970)
    28-40: isentropic secant modulus.
    """
    return np.asarray(10.0 ** (-_SOFTER * (T - T_0)))
