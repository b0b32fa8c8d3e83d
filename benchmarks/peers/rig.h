/* The rig of the solver check in plain C: eqs. (4.1)-(4.22), written from the equations and Tables 2.1 and 4.1 alone,
 * so that a slip in Sealscope's own laws cannot repeat itself here. Fixed volumes, summed Coulomb pressure, continuous
 * friction, throttled return on both sides, no leakage.
 *
 * State: I [rad], i [A], omega [rad/s], theta [rad], x [m], v [m/s], p_A, p_B, p_1, p_2 [Pa]; without throttles the
 * last two are not integrated.
 */
#ifndef SEALSCOPE_PEER_RIG_H
#define SEALSCOPE_PEER_RIG_H

#include <math.h>

#define STATES 10
#define CHARGE 0.25e6 /* Pa, every pressure at the start */

typedef struct {
    int throttled;
    double amplitude;    /* V */
    double frequency;    /* rad/s */
    double free_flow;    /* m^3/(s Pa^0.5): throttle towards the cylinder */
    double return_flow;  /* m^3/(s Pa^0.5): throttle back from it */
} Case;

static inline Case make_case(int throttled, double closed, double amplitude, double frequency) {
    const double diameter = 7e-3, C_d = 0.92, rho = 847.0;
    const double area = 3.14159265358979323846 / 4.0 * diameter * diameter;
    Case c;
    c.throttled = throttled;
    c.amplitude = amplitude;
    c.frequency = frequency;
    c.free_flow = C_d * area * sqrt(2.0 / rho);
    c.return_flow = c.free_flow * (1.0 - closed);
    return c;
}

static inline double friction(double v, double p_A, double p_B) {
    const double F_C = 25.0 + 1e-6 * (p_A + p_B), K_brk = 3.0, C_c = 10.0, F_v = 300.0, v_th = 0.01;
    const double speed = fabs(v);
    if (speed <= v_th) return v * (F_C * (1.0 + (K_brk - 1.0) * exp(-C_c * v_th)) + F_v * v_th) / v_th;
    return copysign(F_C * (1.0 + (K_brk - 1.0) * exp(-C_c * speed)), v) + F_v * v;
}

static inline double orifice(double dp, double c) {
    const double dp_0 = 2000.0;
    return c * dp / sqrt(sqrt(dp * dp + dp_0 * dp_0));
}

static inline double clip(double value, double limit) {
    return value > limit ? limit : (value < -limit ? -limit : value);
}

static inline void derivatives(double u, const double *y, double *dy, const Case *c) {
    const double omega_per_volt = 26.7, k_p = 1.2, K_i = 0.1, V_max = 260.0, i_max = 23.0;
    const double R = 0.73, L = 3.55e-3, C_e = 0.6963, C_m = 0.6963, J = 0.000874, B = 4.855e-4;
    const double displacement = 4.9e-6 / (2.0 * 3.14159265358979323846);
    const double A = 633e-6, M = 12.3, V = 234e-6, V_line = 50e-6, K = 689e6, stroke = 0.6, k_stop = 1e7, d_stop = 1.1e4;
    const double i = y[1], omega = y[2], x = y[4], v = y[5], p_A = y[6], p_B = y[7];
    const double p_1 = c->throttled ? y[8] : p_A, p_2 = c->throttled ? y[9] : p_B;
    const double error = omega_per_volt * u - omega;
    const double Q_1 = displacement * omega;
    double current_rate = (clip(k_p * error + K_i * y[0], V_max) - R * i - C_e * omega) / L;
    double stop = 0.0, Q_A = Q_1, Q_B = Q_1;
    if ((i >= i_max && current_rate > 0.0) || (i <= -i_max && current_rate < 0.0)) current_rate = 0.0;
    if (x > 0.5 * stroke) stop = -fmax(0.0, k_stop * (x - 0.5 * stroke) + d_stop * v);
    if (x < -0.5 * stroke) stop = -fmin(0.0, k_stop * (x + 0.5 * stroke) + d_stop * v);
    if (c->throttled) {
        Q_A = orifice(p_1 - p_A, p_1 > p_A ? c->free_flow : c->return_flow);
        Q_B = orifice(p_B - p_2, p_B > p_2 ? c->return_flow : c->free_flow);
        dy[8] = K / V_line * (Q_1 - Q_A);
        dy[9] = K / V_line * (Q_B - Q_1);
    }
    dy[0] = error;
    dy[1] = current_rate;
    dy[2] = (C_m * i - B * omega - displacement * (p_1 - p_2)) / J;
    dy[3] = omega;
    dy[4] = v;
    dy[5] = ((p_A - p_B) * A - friction(v, p_A, p_B) + stop) / M;
    dy[6] = K / V * (Q_A - A * v);
    dy[7] = K / V * (A * v - Q_B);
}

static inline void start_state(double *y) {
    for (int m = 0; m < STATES; m++) y[m] = m < 6 ? 0.0 : CHARGE;
}

#endif
