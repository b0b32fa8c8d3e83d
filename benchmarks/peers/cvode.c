/* SUNDIALS CVODE (backward differentiation formulas, Newton, dense linear solver, Jacobian by differences).
 *
 *   cvode THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION RTOL RATE FILE
 *
 * Writes (x, p_A, p_B) as doubles at RATE [Hz] to FILE; prints the processor seconds the integration took, steps and evaluations.
 * Absolute tolerances are RTOL times what each state measures on this rig.
 */

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <cvode/cvode.h>
#include <nvector/nvector_serial.h>
#include <sundials/sundials_context.h>
#include <sunlinsol/sunlinsol_dense.h>
#include <sunmatrix/sunmatrix_dense.h>

#include "rig.h"

static const double SCALE[STATES] = {10.0, 1.0, 10.0, 10.0, 0.01, 0.01, 1e5, 1e5, 1e5, 1e5};

static int right_hand_side(realtype t, N_Vector y, N_Vector dy, void *data) {
    const Case *c = (const Case *)data;
    derivatives(c->amplitude * sin(c->frequency * t), N_VGetArrayPointer(y), N_VGetArrayPointer(dy), c);
    return 0;
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int main(int argc, char **argv) {
    if (argc != 9) {
        fprintf(stderr, "usage: %s THROTTLED CLOSED AMPLITUDE FREQUENCY DURATION RTOL RATE FILE\n", argv[0]);
        return 2;
    }
    Case c = make_case(atoi(argv[1]), atof(argv[2]), atof(argv[3]), atof(argv[4]));
    const double duration = atof(argv[5]), rtol = atof(argv[6]), rate = atof(argv[7]);
    const long rows = lround(duration * rate), size = c.throttled ? 10 : 8;
    double *out = malloc(3 * sizeof(double) * (size_t)rows);
    SUNContext context;
    if (out == NULL || SUNContext_Create(NULL, &context)) return 1;
    N_Vector y = N_VNew_Serial(size, context), tolerance = N_VNew_Serial(size, context);
    double start[STATES];
    start_state(start);
    for (long m = 0; m < size; m++) {
        NV_Ith_S(y, m) = start[m];
        NV_Ith_S(tolerance, m) = rtol * SCALE[m];
    }
    void *memory = CVodeCreate(CV_BDF, context);
    SUNMatrix matrix = SUNDenseMatrix(size, size, context);
    SUNLinearSolver solver = SUNLinSol_Dense(y, matrix, context);
    if (CVodeInit(memory, right_hand_side, 0.0, y) || CVodeSVtolerances(memory, rtol, tolerance)
        || CVodeSetLinearSolver(memory, solver, matrix) || CVodeSetUserData(memory, &c)
        || CVodeSetMaxNumSteps(memory, 10000000))
        return 1;
    const double before = now();
    double t = 0.0;
    for (long k = 0; k < rows; k++) {
        if (k > 0 && CVode(memory, (double)k / rate, y, &t, CV_NORMAL) < 0) return 1;
        out[3 * k] = NV_Ith_S(y, 4);
        out[3 * k + 1] = NV_Ith_S(y, 6);
        out[3 * k + 2] = NV_Ith_S(y, 7);
    }
    const double took = now() - before;
    long steps = 0, evaluations = 0;
    CVodeGetNumSteps(memory, &steps);
    CVodeGetNumRhsEvals(memory, &evaluations);
    FILE *file = fopen(argv[8], "wb");
    if (file == NULL || fwrite(out, 3 * sizeof(double), (size_t)rows, file) != (size_t)rows) return 1;
    fclose(file);
    printf("%.6f %ld %ld\n", took, steps, evaluations);
    CVodeFree(&memory);
    SUNLinSolFree(solver);
    SUNMatDestroy(matrix);
    N_VDestroy(y);
    N_VDestroy(tolerance);
    SUNContext_Free(&context);
    free(out);
    return 0;
}
