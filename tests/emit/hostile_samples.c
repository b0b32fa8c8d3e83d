/* Feed hostile samples to the estimator: lost, infinite, huge, stuck, zero, with jumps of the clock and power cuts. Then
   restore what healthy recordings showed, or acknowledge the alarm only, feed samples from standard input, and print the
   results of each block. Arguments: number of hostile samples, and 1 to restore. */
#include "leak.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static leak_state state;
static double saved[LEAK_SAVED];
static double commissioned[LEAK_SAVED];
static uint64_t seed = 88172645463325252u;

static uint64_t draw(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed;
}

static double uniform(void)
{
    return (double)(draw() >> 11) / 9007199254740992.0;
}

/* Feed a sample, and do the parts of the work that it owes. */
static void feed(const double reading[4])
{
    int k;
    leak_sample(&state, (leak_real)reading[0], (leak_real)reading[1], (leak_real)reading[2], (leak_real)reading[3]);
    for (k = 0; k < PARTS; ++k) {
        (void)leak_step(&state);
    }
}

int main(int argc, char **argv)
{
    const long n = (argc > 1) ? atol(argv[1]) : 1000000L;
    static const double scale[4] = {1e6, 1e6, 10.0, 0.1};
    double reading[4] = {0.0, 0.0, 0.0, 0.0};
    double t = 0.0;
    int kind = 0;
    long i;
    int k;
    char line[256];
    int32_t blocks;
    leak_init(&state);
    leak_save(&state, commissioned);
    for (i = 0; i < n; ++i) {
        if ((draw() % 700u) == 0u) {
            kind = (int)(draw() % 9u);
            t += (kind == 8) ? (uniform() * 1e4) : 0.0; /* the clock jumps */
        }
        t += 1.0 / RATE;
        for (k = 0; k < 4; ++k) {
            const double usual = scale[k] * (((k == 0) ? 1.5 : 1.0) + sin((4.0 * t) + (double)k) + (1e-3 * uniform()));
            if (kind == 1) {
                reading[k] = ((draw() % 3u) == 0u) ? NAN : usual;
            } else if (kind == 2) {
                reading[k] = ((draw() & 1u) == 0u) ? INFINITY : -INFINITY;
            } else if (kind == 3) {
                reading[k] = (uniform() - 0.5) * pow(10.0, (600.0 * uniform()) - 300.0);
            } else if (kind == 4) {
                reading[k] = ((draw() % 50u) == 0u) ? (usual * pow(10.0, 12.0 * uniform())) : usual;
            } else if ((kind == 5) && (k == (int)(seed % 4u))) {
                /* stuck */
            } else if (kind == 6) {
                reading[k] = 0.0;
            } else {
                reading[k] = usual;
            }
        }
        feed(reading);
        if ((draw() % 4000u) == 0u) {
            leak_acknowledge(&state);
        }
        if ((draw() % 20000u) == 0u) { /* a power cut: what was saved comes back */
            leak_save(&state, saved);
            memset(&state, (int)(draw() & 0xFFu), sizeof(state));
            if (!leak_restore(&state, saved)) {
                return 2;
            }
            ((unsigned char *)saved)[draw() % sizeof(saved)] ^= (unsigned char)(1u << (draw() % 8u));
            if (leak_restore(&state, saved)) {
                return 3;
            }
        }
        if ((draw() % 1000u) == 0u) {
            leak_results(&state);
        }
    }
    if ((argc > 2) && (atol(argv[2]) == 1L)) {
        if (!leak_restore(&state, commissioned)) {
            return 4;
        }
    } else {
        leak_acknowledge(&state);
    }
    blocks = state.n_ended;
    while (fgets(line, (int)sizeof(line), stdin) != NULL) {
        char *text = line;
        for (k = 0; k < 4; ++k) {
            reading[k] = strtod(text, &text);
            text += (*text == ',') ? 1 : 0;
        }
        feed(reading);
        if ((state.phase == 0) && (state.n_ended != blocks)) {
            blocks = state.n_ended;
            leak_results(&state);
            for (k = 0; k < LEAK_REASON + 1; ++k) {
                printf("%.17g%s", (double)state.results[k], (k < LEAK_REASON) ? "," : "\n");
            }
        }
    }
    return 0;
}
