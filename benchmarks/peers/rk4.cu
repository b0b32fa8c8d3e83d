// Classical Runge-Kutta in CUDA C++, one thread a run: what a program of one's own for a GPU would cost.
//
//   rk4_gpu RUNS THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE
//
// Runs differ in their amplitude by a millionth each. Writes (x, p_A, p_B) of the first as doubles at RATE [Hz] to FILE;
// prints the seconds that the integration of all took.

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include <cuda_runtime.h>
#include <math.h>

#define inline __host__ __device__ inline
#include "rig.h"
#undef inline

template <bool throttled>
__global__ void integrate(Case given, long runs, double h, long n, long every, double *ends, double *rows) {
    constexpr int size = throttled ? 10 : 8;
    const long run = blockIdx.x * static_cast<long>(blockDim.x) + threadIdx.x;
    if (run >= runs) return;
    Case c = given;
    c.throttled = throttled;
    c.amplitude *= 1.0 + 1e-6 * run;
    double y[STATES], z[STATES], k[STATES], sum[STATES];
    start_state(y);
    double u_start = 0.0;
    for (long step = 0; step < n; step++) {
        if (run == 0 && step % every == 0) {
            double *row = rows + 3 * (step / every);
            row[0] = y[4], row[1] = y[6], row[2] = y[7];
        }
        const double u_mid = c.amplitude * sin(c.frequency * (step + 0.5) * h);
        const double u_end = c.amplitude * sin(c.frequency * (step + 1.0) * h);
        derivatives(u_start, y, k, &c);
#pragma unroll
        for (int m = 0; m < size; m++) sum[m] = k[m], z[m] = y[m] + 0.5 * h * k[m];
        derivatives(u_mid, z, k, &c);
#pragma unroll
        for (int m = 0; m < size; m++) sum[m] += 2.0 * k[m], z[m] = y[m] + 0.5 * h * k[m];
        derivatives(u_mid, z, k, &c);
#pragma unroll
        for (int m = 0; m < size; m++) sum[m] += 2.0 * k[m], z[m] = y[m] + h * k[m];
        derivatives(u_end, z, k, &c);
#pragma unroll
        for (int m = 0; m < size; m++) y[m] += h / 6.0 * (sum[m] + k[m]);
        y[1] = clip(y[1], 23.0);
        u_start = u_end;
    }
    ends[run] = y[4] + y[6] + y[7];
}

static void check(cudaError_t status) {
    if (status == cudaSuccess) return;
    std::fprintf(stderr, "%s\n", cudaGetErrorString(status));
    std::exit(1);
}

int main(int argc, char **argv) {
    if (argc != 10) {
        std::fprintf(stderr, "usage: %s RUNS THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION STEP RATE FILE\n", argv[0]);
        return 2;
    }
    const long runs = std::atol(argv[1]);
    const bool throttled = std::atoi(argv[2]) != 0;
    const Case c = make_case(throttled, std::atof(argv[3]), std::atof(argv[4]), std::atof(argv[5]));
    const double duration = std::atof(argv[6]), step = std::atof(argv[7]), rate = std::atof(argv[8]);
    const long every = static_cast<long>(std::ceil(1.0 / (rate * step) * (1.0 - 1e-9)));
    const double h = 1.0 / (rate * every);
    const long n = std::lround(duration * rate) * every;
    std::vector<double> rows(3 * static_cast<size_t>(n / every));
    double *ends, *kept;
    check(cudaMalloc(&ends, runs * sizeof(double)));
    check(cudaMalloc(&kept, rows.size() * sizeof(double)));
    cudaEvent_t before, after;
    check(cudaEventCreate(&before));
    check(cudaEventCreate(&after));
    const int threads = 64;
    const unsigned blocks = static_cast<unsigned>((runs + threads - 1) / threads);
    check(cudaEventRecord(before));
    if (throttled)
        integrate<true><<<blocks, threads>>>(c, runs, h, n, every, ends, kept);
    else
        integrate<false><<<blocks, threads>>>(c, runs, h, n, every, ends, kept);
    check(cudaGetLastError());
    check(cudaEventRecord(after));
    check(cudaEventSynchronize(after));
    float took = 0.0f;
    check(cudaEventElapsedTime(&took, before, after));
    check(cudaMemcpy(rows.data(), kept, rows.size() * sizeof(double), cudaMemcpyDeviceToHost));
    std::FILE *file = std::fopen(argv[9], "wb");
    if (file == nullptr || std::fwrite(rows.data(), sizeof(double), rows.size(), file) != rows.size()) return 1;
    std::fclose(file);
    std::printf("%.6f\n", took / 1e3);
    return 0;
}
