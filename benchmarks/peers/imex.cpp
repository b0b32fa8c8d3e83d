// ARK4(3)6L[2]SA of Kennedy and Carpenter (2003) in scalar C++: the throttles' flows implicitly, one scalar equation a
// side, all else explicitly; what a compiled program of one's own would cost at the same scheme.
//
//   imex THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE
//
// THROTTLED must be 1. Writes (x, p_A, p_B) as doubles at RATE [Hz] to FILE; prints the processor seconds it took.

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

#include "rig.h"

static const int STAGES = 6;
static const double GAMMA = 0.25;
static const double NODE[STAGES] = {0.0, 1.0 / 2, 83.0 / 250, 31.0 / 50, 17.0 / 20, 1.0};
static const double EXPLICIT[STAGES][STAGES] = {
    {},
    {1.0 / 2},
    {13861.0 / 62500, 6889.0 / 62500},
    {-116923316275.0 / 2393684061468, -2731218467317.0 / 15368042101831, 9408046702089.0 / 11113171139209},
    {-451086348788.0 / 2902428689909, -2682348792572.0 / 7519795681897, 12662868775082.0 / 11960479115383,
     3355817975965.0 / 11060851509271},
    {647845179188.0 / 3216320057751, 73281519250.0 / 8382639484533, 552539513391.0 / 3454668386233,
     3354512671639.0 / 8306763924573, 4040.0 / 17871},
};
static const double IMPLICIT[STAGES][STAGES] = {
    {},
    {1.0 / 4},
    {8611.0 / 62500, -1743.0 / 31250},
    {5012029.0 / 34652500, -654441.0 / 2922500, 174375.0 / 388108},
    {15267082809.0 / 155376265600, -71443401.0 / 120774400, 730878875.0 / 902184768, 2285395.0 / 8070912},
    {82889.0 / 524892, 0.0, 15625.0 / 83664, 69875.0 / 102672, -2260.0 / 8211},
};
static const double WEIGHT[STAGES] = {82889.0 / 524892, 0.0, 15625.0 / 83664, 69875.0 / 102672, -2260.0 / 8211, 0.25};

static const double K = 689e6, V = 234e-6, V_LINE = 50e-6;

// d + g Q(d) = total by Newton's method from the tangent at zero or from the bare square root, whichever is nearer.
static inline double drop(double total, double g, double c) {
    const double dp_0 = 2000.0, gc = g * c, size = std::fabs(total);
    const double root = 0.5 * (std::sqrt(gc * gc + 4.0 * size) - gc);
    double d = std::fmax(root * root, size / (1.0 + gc / std::sqrt(dp_0)));
    for (int turn = 0; turn < 20; turn++) {
        const double square = d * d + dp_0 * dp_0, fourth = 1.0 / std::sqrt(std::sqrt(square));
        const double step = (d + gc * d * fourth - size) / (1.0 + gc * fourth * (1.0 - 0.5 * d * d / square));
        d -= step;
        if (std::fabs(step) <= 1e-6 * d) break;
    }
    return std::copysign(d, total);
}

static void integrate(const Case &c, double h, long n, long every, std::vector<double> &rows) {
    double y[STATES], z[STATES], f[STAGES][STATES], s[STAGES][4];
    const double g = GAMMA * h * (K / V + K / V_LINE);
    Case blind = c;  // no flow through the throttles: `derivatives` without its implicit part
    blind.free_flow = blind.return_flow = 0.0;
    start_state(y);
    for (long step = 0; step < n; step++) {
        if (step % every == 0) {
            rows.push_back(y[4]);
            rows.push_back(y[6]);
            rows.push_back(y[7]);
        }
        for (int k = 0; k < STAGES; k++) {
            for (int m = 0; m < STATES; m++) {
                double sum = 0.0;
                for (int j = 0; j < k; j++) sum += EXPLICIT[k][j] * f[j][m];
                z[m] = y[m] + h * sum;
            }
            for (int m = 0; m < 4; m++) {
                double sum = 0.0;
                for (int j = 0; j < k; j++) sum += IMPLICIT[k][j] * s[j][m];
                z[6 + m] += h * sum;
            }
            double Q_A, Q_B;
            const double d_A = z[8] - z[6], d_B = z[7] - z[9];
            const double c_A = d_A > 0.0 ? c.free_flow : c.return_flow, c_B = d_B > 0.0 ? c.return_flow : c.free_flow;
            if (k == 0) {
                Q_A = orifice(d_A, c_A);
                Q_B = orifice(d_B, c_B);
            } else {
                Q_A = (d_A - drop(d_A, g, c_A)) / g;
                Q_B = (d_B - drop(d_B, g, c_B)) / g;
            }
            const double rate[4] = {K / V * Q_A, -K / V * Q_B, -K / V_LINE * Q_A, K / V_LINE * Q_B};
            for (int m = 0; m < 4; m++) {
                s[k][m] = rate[m];
                if (k > 0) z[6 + m] += GAMMA * h * rate[m];
            }
            derivatives(c.amplitude * std::sin(c.frequency * (step + NODE[k]) * h), z, f[k], &blind);
        }
        for (int m = 0; m < STATES; m++) {
            double sum = 0.0;
            for (int k = 0; k < STAGES; k++) sum += WEIGHT[k] * (f[k][m] + (m >= 6 ? s[k][m - 6] : 0.0));
            y[m] += h * sum;
        }
        y[1] = clip(y[1], 23.0);
    }
}

int main(int argc, char **argv) {
    if (argc != 9 || std::atoi(argv[1]) != 1) {
        std::fprintf(stderr, "usage: %s 1 CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE\n", argv[0]);
        return 2;
    }
    const Case c = make_case(1, std::atof(argv[2]), std::atof(argv[3]), std::atof(argv[4]));
    const double duration = std::atof(argv[5]), step = std::atof(argv[6]), rate = std::atof(argv[7]);
    const long every = static_cast<long>(std::ceil(1.0 / (rate * step) * (1.0 - 1e-9)));
    const double h = 1.0 / (rate * every);
    const long n = std::lround(duration * rate) * every;
    std::vector<double> rows;
    rows.reserve(3 * static_cast<size_t>(n / every + 1));
    const std::clock_t before = std::clock();
    integrate(c, h, n, every, rows);
    const double took = static_cast<double>(std::clock() - before) / CLOCKS_PER_SEC;
    std::FILE *file = std::fopen(argv[8], "wb");
    if (file == nullptr || std::fwrite(rows.data(), sizeof(double), rows.size(), file) != rows.size()) return 1;
    std::fclose(file);
    std::printf("%.6f\n", took);
    return 0;
}
