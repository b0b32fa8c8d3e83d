"""Properties of the oil: bulk modulus and density with free air in it, and their change with temperature."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import contracted
from sealscope.physics.lanes import exponential
from sealscope.units import P_ATM

#: 40 and 100 deg C [K], at which data sheets state viscosities.
_T_40, _T_100 = 313.15, 373.15
#: Decrease of log10(bulk modulus) of mineral oils per kelvin [1/K].
_LOG_MODULUS_SLOPE = 0.0024
#: Lowest absolute pressure [Pa] in the law of the air, whose volume would otherwise grow without bound.
_MIN_ABSOLUTE_PRESSURE = 100.0


@contracted
def effective_bulk_modulus(p: float, K_oil: float, air: float, n_air: float) -> float:
    """Compute the bulk modulus [Pa] of oil with free air at the pressure `p` [Pa gauge].

    K = K_oil (1 + r)/(1 + r K_oil/(n p_abs)), with the modulus `K_oil` [Pa] of the oil without air and the volume r of
    air over the volume of oil (`air_volume_ratio`, which explains the other arguments). Air does not dissolve.

    Source: H. E. Merritt, Hydraulic Control Systems, 1967, effective bulk modulus (1/K is the sum of the compliances of
    liquid and gas). The Simscape library, from which the thesis took its friction law, has the same formula.
    """
    if not air > 0.0:
        return K_oil
    p_abs = max(p + P_ATM, _MIN_ABSOLUTE_PRESSURE)
    r = air_volume_ratio(p, air, n_air)
    return K_oil * (1.0 + r) / (1.0 + r * K_oil / (n_air * p_abs))


@contracted
def oil_density_ratio(dp: float, K_oil: float) -> float:
    """Compute the density ratio rho(p + dp)/rho(p) = exp(dp/K_oil) of oil without air.

    `dp` [Pa]: difference of the two pressures; `K_oil` [Pa]: bulk modulus. Source: Merritt, Hydraulic Control Systems,
    1967, definition of the bulk modulus, K = rho dp/d rho, K constant.
    """
    return exponential(dp / K_oil)  # type: ignore[no-any-return]


@contracted
def air_volume_ratio(p: float, air: float, n_air: float) -> float:
    """Compute the volume of free air over the volume of oil at the pressure `p` [Pa gauge].

    It is air (p_atm/p_abs)^(1/n): `air` is the ratio at atmospheric pressure, `n_air` the polytropic exponent n. The
    absolute pressure p_abs is taken as at least 100 Pa.
    """
    return air * math.pow(P_ATM / max(p + P_ATM, _MIN_ABSOLUTE_PRESSURE), 1.0 / n_air)


@contracted
def mixture_density_ratio(p: float, p_0: float, K_oil: float, air: float, n_air: float) -> float:
    """Compute the density ratio rho(p)/rho(p_0) of oil with free air, both pressures in Pa gauge.

    Its logarithm is the integral of dp/K from p_0 to p, with the modulus K of `effective_bulk_modulus`:

    - the air contributes ln((1 + r_0)/(1 + r)) exactly, with the `air_volume_ratio` r at p and r_0 at p_0;
    - the liquid, of bulk modulus `K_oil` [Pa], contributes the integral of dp/(K_oil (1 + r)), which is computed by
      Simpson's rule with an error below max(r, r_0) |p - p_0|/(6 K_oil).
    """
    r, r_0 = air_volume_ratio(p, air, n_air), air_volume_ratio(p_0, air, n_air)
    r_m = air_volume_ratio(0.5 * (p + p_0), air, n_air)
    # mean of 1/(1 + r) between both pressures, by Simpson's rule
    mean_liquid_fraction = (1.0 / (1.0 + r) + 4.0 / (1.0 + r_m) + 1.0 / (1.0 + r_0)) / 6.0
    return (1.0 + r_0) / (1.0 + r) * exponential((p - p_0) * mean_liquid_fraction / K_oil)  # type: ignore[no-any-return]


def kinematic_viscosity(T: NDArray[np.float64], nu_40: float, nu_100: float) -> NDArray[np.float64]:
    """Compute an oil's kinematic viscosity [m^2/s] at the temperatures T [K] by Walther's law.

    `nu_40`, `nu_100` [m^2/s]: its viscosity at 40 and 100 deg C. Source: ASTM D341, log log(nu + 0.7) = A - B log T, nu
    in mm^2/s (for nu above 2 mm^2/s).
    """
    y_40, y_100 = (math.log(math.log(1e6 * nu + 0.7)) for nu in (nu_40, nu_100))
    B = (y_40 - y_100) / math.log(_T_100 / _T_40)
    return np.asarray(1e-6 * (np.exp(np.exp(y_40 - B * np.log(T / _T_40))) - 0.7))


def thermal_density_ratio(T: NDArray[np.float64], T_0: float, alpha: float) -> NDArray[np.float64]:
    """Compute the density ratio rho(T)/rho(T_0) = 1 - alpha (T - T_0) of an oil at the temperatures T and T_0 [K].

    `alpha` [1/K]: thermal expansion. Source: Merritt, Hydraulic Control Systems, 1967, section 2.2 (petroleum fluids).
    """
    return np.asarray(1.0 - alpha * (T - T_0))


def thermal_stiffness_ratio(T: NDArray[np.float64], T_0: float) -> NDArray[np.float64]:
    """Compute the ratio K(T)/K(T_0) of a mineral oil's bulk modulus at the temperatures T [K] to that at T_0 [K].

    It is 10^(-0.0024 (T - T_0)). Source: A. T. J. Hayward, How to estimate the bulk modulus of hydraulic fluids,
    Hydraulic Pneumatic Power 16 (1970) 28-40: isentropic secant modulus.
    """
    return np.asarray(10.0 ** (-_LOG_MODULUS_SLOPE * (T - T_0)))
