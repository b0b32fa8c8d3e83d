/* A unit's instance: its numbers in one block, so that a copy of the block is the whole state. */
#ifndef SEALSCOPE_UNIT_H
#define SEALSCOPE_UNIT_H

#include <stddef.h>
#include <stdint.h>

#include "config.h"

enum { OK = 0, NOT_FINITE = 1, BELOW_VACUUM = 2, NOT_HELD = 3, WRONG_CALL = 4 };
typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED } Phase;

typedef struct {
    double time, start_position, step;
    double y[N_STATES], values[N_VALUES], inputs[N_INPUTS], slopes[N_INPUTS], results[N_RESULTS];
    int64_t phase, fresh; /* fresh: the results belong to the state */
} Block;

typedef void (*Report)(void *environment, const char *name, int code, const char *message);

typedef struct {
    Block block;
    char *name, message[200];
    void *environment, *logger; /* of the importer */
    Report report;
} Instance;

Instance *unit_new(const char *name, const char *token, void *environment, void *logger, Report report);
void unit_free(Instance *unit);
void unit_reset(Instance *unit);
int unit_initialize(Instance *unit, double start);
int unit_started(Instance *unit); /* ends the initialization at standstill */
int unit_get(Instance *unit, uint32_t reference, double *value);
int unit_set(Instance *unit, uint32_t reference, double value);
int unit_set_slope(Instance *unit, uint32_t reference, double slope);
int unit_advance(Instance *unit, double time, double span);
/* copies a block of `size` bytes to *state, which is allocated if it is NULL */
int unit_keep(Instance *unit, void **state, const void *block, size_t size);
/* reports a message to the importer, and returns `code` */
int unit_refuse(Instance *unit, int code, const char *format, ...);

/* What the unit computes. The first two write a code of failure, or 0, to `code`. */
void sealscope_start(int64_t *code, const double *values, const double *inputs, double x_0, double *y);
void sealscope_advance(int64_t *code, const double *values, const double *inputs, const double *slopes, double *y,
                       double span, int64_t steps);
void sealscope_report(const double *values, const double *inputs, double *y, double *results);

#endif
