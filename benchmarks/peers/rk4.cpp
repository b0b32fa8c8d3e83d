// Classical Runge-Kutta in scalar C++: what a compiled program of one's own would cost.
//
//   rk4 THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE
//
// Writes (x, p_A, p_B) as doubles at RATE [Hz] to FILE; prints the processor seconds the integration took.

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

#include "rig.h"

template <bool throttled>
static void integrate(const Case &given, double h, long n, long every, std::vector<double> &rows) {
    constexpr int size = throttled ? 10 : 8;
    Case c = given;
    c.throttled = throttled;
    double y[STATES], z[STATES], k1[STATES], k2[STATES], k3[STATES], k4[STATES];
    start_state(y);
    double u_start = 0.0;
    for (long step = 0; step < n; step++) {
        if (step % every == 0) {
            rows.push_back(y[4]);
            rows.push_back(y[6]);
            rows.push_back(y[7]);
        }
        const double u_mid = c.amplitude * std::sin(c.frequency * (step + 0.5) * h);
        const double u_end = c.amplitude * std::sin(c.frequency * (step + 1.0) * h);
        derivatives(u_start, y, k1, &c);
        for (int m = 0; m < size; m++) z[m] = y[m] + 0.5 * h * k1[m];
        derivatives(u_mid, z, k2, &c);
        for (int m = 0; m < size; m++) z[m] = y[m] + 0.5 * h * k2[m];
        derivatives(u_mid, z, k3, &c);
        for (int m = 0; m < size; m++) z[m] = y[m] + h * k3[m];
        derivatives(u_end, z, k4, &c);
        for (int m = 0; m < size; m++) y[m] += h / 6.0 * (k1[m] + 2.0 * (k2[m] + k3[m]) + k4[m]);
        y[1] = clip(y[1], 23.0);
        u_start = u_end;
    }
}

int main(int argc, char **argv) {
    if (argc != 9) {
        std::fprintf(stderr, "usage: %s THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE\n", argv[0]);
        return 2;
    }
    const bool throttled = std::atoi(argv[1]) != 0;
    const Case c = make_case(throttled, std::atof(argv[2]), std::atof(argv[3]), std::atof(argv[4]));
    const double duration = std::atof(argv[5]), step = std::atof(argv[6]), rate = std::atof(argv[7]);
    const long every = static_cast<long>(std::ceil(1.0 / (rate * step) * (1.0 - 1e-9)));
    const double h = 1.0 / (rate * every);
    const long n = std::lround(duration * rate) * every;
    std::vector<double> rows;
    rows.reserve(3 * static_cast<size_t>(n / every + 1));
    const std::clock_t before = std::clock();
    throttled ? integrate<true>(c, h, n, every, rows) : integrate<false>(c, h, n, every, rows);
    const double took = static_cast<double>(std::clock() - before) / CLOCKS_PER_SEC;
    std::FILE *file = std::fopen(argv[8], "wb");
    if (file == nullptr || std::fwrite(rows.data(), sizeof(double), rows.size(), file) != rows.size()) return 1;
    std::fclose(file);
    std::printf("%.6f\n", took);
    return 0;
}
