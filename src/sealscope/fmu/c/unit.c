/* What both versions of the interface share: an instance, its variables, its steps. */
#include "unit.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double START_VALUES[N_VALUES] = VALUES_AT_START;
static const char PRESENT[N_VALUES] = VALUES_PRESENT;

int unit_refuse(Instance *unit, int code, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(unit->message, sizeof unit->message, format, arguments);
    va_end(arguments);
    if (unit->report) unit->report(unit, unit->name, code, unit->message);
    return code;
}

static int failure(Instance *unit, int64_t code) {
    static const char *const messages[] = FAILURES;
    return unit_refuse(unit, (int)code, "%s (t = %g s)", messages[code - 1], unit->block.time);
}

Instance *unit_new(const char *name, const char *token, void *environment, void *logger, Report report) {
    Instance *unit;
    if (!token || strcmp(token, TOKEN)) return NULL; /* another unit's description */
    unit = calloc(1, sizeof *unit);
    if (!unit) return NULL;
    unit->name = calloc(1, strlen(name ? name : "") + 1);
    if (!unit->name) {
        free(unit);
        return NULL;
    }
    strcpy(unit->name, name ? name : "");
    unit->environment = environment;
    unit->logger = logger;
    unit->report = report;
    unit_reset(unit);
    return unit;
}

void unit_free(Instance *unit) {
    if (!unit) return;
    free(unit->name);
    free(unit);
}

void unit_reset(Instance *unit) {
    memset(&unit->block, 0, sizeof unit->block);
    memcpy(unit->block.values, START_VALUES, sizeof START_VALUES);
    unit->block.step = START_STEP;
}

static int at_standstill(Instance *unit) {
    Block *b = &unit->block;
    int64_t code = 0;
    sealscope_start(&code, b->values, b->inputs, b->start_position, b->y);
    return code ? failure(unit, code) : OK;
}

int unit_initialize(Instance *unit, double start) {
    if (unit->block.phase != INSTANTIATED) return unit_refuse(unit, WRONG_CALL, "initialization must be entered once");
    unit->block.time = start;
    unit->block.phase = INITIALIZING;
    return OK;
}

int unit_started(Instance *unit) {
    int code;
    if (unit->block.phase != INITIALIZING) return unit_refuse(unit, WRONG_CALL, "initialization must be entered first");
    code = at_standstill(unit);
    if (code) return code;
    unit->block.phase = STEPPING;
    unit->block.fresh = 0;
    return OK;
}

int unit_get(Instance *unit, uint32_t reference, double *value) {
    Block *b = &unit->block;
    /* the differences are unsigned: large for references below the base */
    if (reference == 0) { /* the time, in FMI 3 */
        *value = b->time;
    } else if (reference - INPUT_BASE < N_INPUTS) {
        *value = b->inputs[reference - INPUT_BASE];
    } else if (reference - VALUE_BASE < N_VALUES && PRESENT[reference - VALUE_BASE]) {
        *value = b->values[reference - VALUE_BASE];
    } else if (reference - RESULT_BASE < N_RESULTS) {
        if (!b->fresh) {
            if (b->phase < STEPPING) at_standstill(unit); /* a failure is returned by unit_started */
            sealscope_report(b->values, b->inputs, b->y, b->results);
            b->fresh = 1;
        }
        *value = b->results[reference - RESULT_BASE];
    } else if (reference == START_POSITION) {
        *value = b->start_position;
    } else if (reference == STEP) {
        *value = b->step;
    } else {
        return unit_refuse(unit, WRONG_CALL, "value reference must be one of the description's, got %u", reference);
    }
    return OK;
}

int unit_set(Instance *unit, uint32_t reference, double value) {
    Block *b = &unit->block;
    if (!isfinite(value)) return unit_refuse(unit, WRONG_CALL, "a value must be finite, got one for reference %u that is not", reference);
    if (reference - INPUT_BASE < N_INPUTS) {
        b->inputs[reference - INPUT_BASE] = value;
        b->slopes[reference - INPUT_BASE] = 0.0;
    } else if (reference - VALUE_BASE < N_VALUES && PRESENT[reference - VALUE_BASE]) {
        b->values[reference - VALUE_BASE] = value;
    } else if (reference == START_POSITION || reference == STEP) {
        if (b->phase >= STEPPING) return unit_refuse(unit, WRONG_CALL, "%s must be set before the start", reference == STEP ? "step" : "start_position");
        if (reference == STEP && !(value > 0.0)) return unit_refuse(unit, WRONG_CALL, "step must be > 0 s, got %g", value);
        *(reference == STEP ? &b->step : &b->start_position) = value;
    } else {
        return unit_refuse(unit, WRONG_CALL, "value reference must be that of an input or a parameter, got %u", reference);
    }
    b->fresh = 0;
    return OK;
}

int unit_set_slope(Instance *unit, uint32_t reference, double slope) {
    if (!(reference - INPUT_BASE < N_INPUTS) || !isfinite(slope))
        return unit_refuse(unit, WRONG_CALL, "a derivative must be finite, and that of an input, got %g for reference %u", slope, reference);
    unit->block.slopes[reference - INPUT_BASE] = slope;
    return OK;
}

int unit_advance(Instance *unit, double time, double span) {
    Block *b = &unit->block;
    int64_t code = 0;
    double steps;
    int k;
    if (b->phase != STEPPING) return unit_refuse(unit, WRONG_CALL, "a step must follow the initialization");
    if (!(fabs(time - b->time) <= 1e-9 * (1.0 + fabs(time))))
        return unit_refuse(unit, WRONG_CALL, "a step must begin at t = %.15g s, got %.15g s", b->time, time);
    steps = ceil(span / b->step * (1.0 - 1e-9));
    if (!(span > 0.0 && steps <= 1e9)) return unit_refuse(unit, WRONG_CALL, "a step must be > 0 s and at most %g s, got %g s", 1e9 * b->step, span);
    sealscope_advance(&code, b->values, b->inputs, b->slopes, b->y, span, steps < 1.0 ? 1 : (int64_t)steps);
    b->time = time + span;
    for (k = 0; k < N_INPUTS; k++) b->inputs[k] += b->slopes[k] * span;
    b->fresh = 0;
    return code ? failure(unit, code) : OK;
}

int unit_keep(Instance *unit, void **state, const void *block, size_t size) {
    if (size != sizeof(Block)) return unit_refuse(unit, WRONG_CALL, "a state must have %zu bytes, got %zu", sizeof(Block), size);
    if (!*state) *state = malloc(sizeof(Block));
    if (!*state) return WRONG_CALL;
    memcpy(*state, block, sizeof(Block));
    return OK;
}
