/* FMI 3.0 for co-simulation. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "unit.h"

typedef fmi3ValueReference Reference;

static fmi3Status status_of(int code) { return code ? fmi3Error : fmi3OK; }

static void report(void *instance, const char *name, int code, const char *message) {
    Instance *unit = instance;
    (void)name, (void)code;
    if (unit->logger) ((fmi3LogMessageCallback)unit->logger)(unit->environment, fmi3Error, "logStatusError", message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)c, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const Reference intermediate[], size_t n, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)intermediate, (void)n, (void)update;
    return unit_new(name, token, environment, (void *)log, report);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) { unit_free(c); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    return status_of(unit_initialize(c, start));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return status_of(unit_started(c)); }

fmi3Status fmi3Terminate(fmi3Instance c) {
    ((Instance *)c)->block.phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance c) {
    unit_reset(c);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const Reference r[], size_t n, fmi3Float64 v[], size_t m) {
    size_t k;
    if (n != m) return status_of(unit_refuse(c, WRONG_CALL, "there must be a value a reference, got %zu and %zu", m, n));
    for (k = 0; k < n; k++)
        if (unit_get(c, r[k], &v[k])) return fmi3Error;
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const Reference r[], size_t n, const fmi3Float64 v[], size_t m) {
    size_t k;
    if (n != m) return status_of(unit_refuse(c, WRONG_CALL, "there must be a value a reference, got %zu and %zu", m, n));
    for (k = 0; k < n; k++)
        if (unit_set(c, r[k], v[k])) return fmi3Error;
    return fmi3OK;
}

#define NONE_OF(Type)                                                                                                  \
    fmi3Status fmi3Get##Type(fmi3Instance c, const Reference r[], size_t n, fmi3##Type v[], size_t m) {                \
        (void)c, (void)r, (void)v, (void)m;                                                                            \
        return n ? fmi3Error : fmi3OK;                                                                                 \
    }                                                                                                                  \
    fmi3Status fmi3Set##Type(fmi3Instance c, const Reference r[], size_t n, const fmi3##Type v[], size_t m) {          \
        (void)c, (void)r, (void)v, (void)m;                                                                            \
        return n ? fmi3Error : fmi3OK;                                                                                 \
    }
NONE_OF(Float32)
NONE_OF(Int8)
NONE_OF(UInt8)
NONE_OF(Int16)
NONE_OF(UInt16)
NONE_OF(Int32)
NONE_OF(UInt32)
NONE_OF(Int64)
NONE_OF(UInt64)
NONE_OF(Boolean)
NONE_OF(String)

fmi3Status fmi3GetBinary(fmi3Instance c, const Reference r[], size_t n, size_t sizes[], fmi3Binary v[], size_t m) {
    (void)c, (void)r, (void)sizes, (void)v, (void)m;
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const Reference r[], size_t n, const size_t sizes[], const fmi3Binary v[],
                         size_t m) {
    (void)c, (void)r, (void)sizes, (void)v, (void)m;
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const Reference r[], size_t n, fmi3Clock v[]) {
    (void)c, (void)r, (void)v;
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance c, const Reference r[], size_t n, const fmi3Clock v[]) {
    (void)c, (void)r, (void)v;
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    if (!*state) *state = malloc(sizeof(Block));
    if (!*state) return fmi3Error;
    memcpy(*state, &((Instance *)c)->block, sizeof(Block));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    memcpy(&((Instance *)c)->block, state, sizeof(Block));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    (void)c, (void)state;
    *size = sizeof(Block);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    (void)c;
    if (size < sizeof(Block)) return fmi3Error;
    memcpy(bytes, state, sizeof(Block));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    if (size != sizeof(Block)) return status_of(unit_refuse(c, WRONG_CALL, "a state must have %zu bytes, got %zu", sizeof(Block), size));
    if (!*state) *state = malloc(sizeof(Block));
    if (!*state) return fmi3Error;
    memcpy(*state, bytes, sizeof(Block));
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    (void)c;
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 span, fmi3Boolean no_set_prior,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    int code = unit_advance(c, time, span);
    (void)no_set_prior;
    *event = *terminate = *early = fmi3False;
    *last = ((Instance *)c)->block.time;
    return status_of(code);
}

/* What a unit for co-simulation without events, clocks or derivatives does not do. */
static fmi3Status not_here(fmi3Instance c, const char *what) {
    return status_of(unit_refuse(c, WRONG_CALL, "the unit has no %s", what));
}

#define WITHOUT(name, what)                                                                                            \
    fmi3Status name(fmi3Instance c) { return not_here(c, what); }
WITHOUT(fmi3EnterEventMode, "events")
WITHOUT(fmi3EnterConfigurationMode, "structural parameters")
WITHOUT(fmi3ExitConfigurationMode, "structural parameters")
WITHOUT(fmi3EvaluateDiscreteStates, "events")
WITHOUT(fmi3EnterContinuousTimeMode, "model exchange")

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, Reference r, size_t *n) {
    (void)r, (void)n;
    return not_here(c, "list of dependencies");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, Reference r, size_t e[], Reference i[], size_t o[],
                                       fmi3DependencyKind kinds[], size_t n) {
    (void)r, (void)e, (void)i, (void)o, (void)kinds, (void)n;
    return not_here(c, "list of dependencies");
}

#define DERIVATIVE(name)                                                                                               \
    fmi3Status name(fmi3Instance c, const Reference u[], size_t n, const Reference k[], size_t m,                      \
                    const fmi3Float64 seed[], size_t ns, fmi3Float64 v[], size_t nv) {                                 \
        (void)u, (void)n, (void)k, (void)m, (void)seed, (void)ns, (void)v, (void)nv;                                   \
        return not_here(c, "directional derivatives");                                                                 \
    }
DERIVATIVE(fmi3GetDirectionalDerivative)
DERIVATIVE(fmi3GetAdjointDerivative)

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const Reference r[], size_t n, const fmi3Int32 orders[],
                                    fmi3Float64 v[], size_t m) {
    (void)r, (void)n, (void)orders, (void)v, (void)m;
    return not_here(c, "derivatives of outputs");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const Reference r[], size_t n, fmi3Float64 v[],
                                  fmi3IntervalQualifier q[]) {
    (void)r, (void)n, (void)v, (void)q;
    return not_here(c, "clocks");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const Reference r[], size_t n, fmi3UInt64 a[], fmi3UInt64 b[],
                                   fmi3IntervalQualifier q[]) {
    (void)r, (void)n, (void)a, (void)b, (void)q;
    return not_here(c, "clocks");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const Reference r[], size_t n, fmi3Float64 v[]) {
    (void)r, (void)n, (void)v;
    return not_here(c, "clocks");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const Reference r[], size_t n, fmi3UInt64 a[], fmi3UInt64 b[]) {
    (void)r, (void)n, (void)a, (void)b;
    return not_here(c, "clocks");
}

#define SET_DECIMAL(name)                                                                                              \
    fmi3Status name(fmi3Instance c, const Reference r[], size_t n, const fmi3Float64 v[]) {                            \
        (void)r, (void)n, (void)v;                                                                                     \
        return not_here(c, "clocks");                                                                                  \
    }
SET_DECIMAL(fmi3SetIntervalDecimal)
SET_DECIMAL(fmi3SetShiftDecimal)

#define SET_FRACTION(name)                                                                                             \
    fmi3Status name(fmi3Instance c, const Reference r[], size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]) {       \
        (void)r, (void)n, (void)a, (void)b;                                                                            \
        return not_here(c, "clocks");                                                                                  \
    }
SET_FRACTION(fmi3SetIntervalFraction)
SET_FRACTION(fmi3SetShiftFraction)

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e,
                                    fmi3Boolean *f, fmi3Float64 *t) {
    (void)a, (void)b, (void)d, (void)e, (void)f, (void)t;
    return not_here(c, "events");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, Reference clock, fmi3Float64 time) {
    (void)clock, (void)time;
    return not_here(c, "clocks");
}

/* Model exchange. */
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_prior, fmi3Boolean *a, fmi3Boolean *b) {
    (void)no_set_prior, (void)a, (void)b;
    return not_here(c, "model exchange");
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) {
    (void)time;
    return not_here(c, "model exchange");
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 v[], size_t n) {
    (void)v, (void)n;
    return not_here(c, "model exchange");
}

#define OF_STATES(name)                                                                                                \
    fmi3Status name(fmi3Instance c, fmi3Float64 v[], size_t n) {                                                       \
        (void)v, (void)n;                                                                                              \
        return not_here(c, "model exchange");                                                                          \
    }
OF_STATES(fmi3GetContinuousStateDerivatives)
OF_STATES(fmi3GetEventIndicators)
OF_STATES(fmi3GetContinuousStates)
OF_STATES(fmi3GetNominalsOfContinuousStates)

#define NUMBER_OF(name)                                                                                                \
    fmi3Status name(fmi3Instance c, size_t *n) {                                                                       \
        (void)n;                                                                                                       \
        return not_here(c, "model exchange");                                                                          \
    }
NUMBER_OF(fmi3GetNumberOfEventIndicators)
NUMBER_OF(fmi3GetNumberOfContinuousStates)
