/* FMI 3.0 for co-simulation. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "unit.h"

typedef fmi3ValueReference Reference;

static fmi3Status status_of(int code) { return code ? fmi3Error : fmi3OK; }

static void report(void *instance, const char *name, int code, const char *message) {
    Instance *unit = instance;
    if (unit->logger) ((fmi3LogMessageCallback)unit->logger)(unit->environment, fmi3Error, "logStatusError", message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const Reference intermediate[], size_t n, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    return unit_new(name, token, environment, (void *)log, report);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) { unit_free(c); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop) {
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
        return n ? fmi3Error : fmi3OK;                                                                                 \
    }                                                                                                                  \
    fmi3Status fmi3Set##Type(fmi3Instance c, const Reference r[], size_t n, const fmi3##Type v[], size_t m) {          \
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
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const Reference r[], size_t n, const size_t sizes[], const fmi3Binary v[],
                         size_t m) {
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const Reference r[], size_t n, fmi3Clock v[]) {
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance c, const Reference r[], size_t n, const fmi3Clock v[]) {
    return n ? fmi3Error : fmi3OK;
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    return status_of(unit_keep(c, state, &((Instance *)c)->block, sizeof(Block)));
}
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    memcpy(&((Instance *)c)->block, state, sizeof(Block));
    return fmi3OK;
}
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    free(*state);
    *state = NULL;
    return fmi3OK;
}
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    *size = sizeof(Block);
    return fmi3OK;
}
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (size < sizeof(Block)) return fmi3Error;
    memcpy(bytes, state, sizeof(Block));
    return fmi3OK;
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    return status_of(unit_keep(c, state, bytes, size));
}

fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 span, fmi3Boolean no_set_prior,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    int code = unit_advance(c, time, span);
    *event = *terminate = *early = fmi3False;
    *last = ((Instance *)c)->block.time;
    return status_of(code);
}

/* What a unit for co-simulation without events, clocks or derivatives does not do. */
static fmi3Status not_here(fmi3Instance c, const char *what) {
    return status_of(unit_refuse(c, WRONG_CALL, "the unit has no %s", what));
}

#define WITHOUT(name, what, ...)                                                                                       \
    fmi3Status name(fmi3Instance c, __VA_ARGS__) { return not_here(c, what); }
#define WITHOUT_ANY(name, what)                                                                                        \
    fmi3Status name(fmi3Instance c) { return not_here(c, what); }
#define DERIVATIVE                                                                                                     \
    const Reference u[], size_t n, const Reference k[], size_t m, const fmi3Float64 seed[], size_t ns, fmi3Float64 v[], \
        size_t nv
#define VARIABLES const Reference r[], size_t n
WITHOUT_ANY(fmi3EnterEventMode, "events")
WITHOUT_ANY(fmi3EnterConfigurationMode, "structural parameters")
WITHOUT_ANY(fmi3ExitConfigurationMode, "structural parameters")
WITHOUT_ANY(fmi3EvaluateDiscreteStates, "events")
WITHOUT_ANY(fmi3EnterContinuousTimeMode, "model exchange")
WITHOUT(fmi3GetNumberOfVariableDependencies, "list of dependencies", Reference r, size_t *n)
WITHOUT(fmi3GetVariableDependencies, "list of dependencies", Reference r, size_t e[], Reference i[], size_t o[],
        fmi3DependencyKind kinds[], size_t n)
WITHOUT(fmi3GetDirectionalDerivative, "directional derivatives", DERIVATIVE)
WITHOUT(fmi3GetAdjointDerivative, "directional derivatives", DERIVATIVE)
WITHOUT(fmi3GetOutputDerivatives, "derivatives of outputs", VARIABLES, const fmi3Int32 orders[], fmi3Float64 v[], size_t m)
WITHOUT(fmi3GetIntervalDecimal, "clocks", VARIABLES, fmi3Float64 v[], fmi3IntervalQualifier q[])
WITHOUT(fmi3GetIntervalFraction, "clocks", VARIABLES, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[])
WITHOUT(fmi3GetShiftDecimal, "clocks", VARIABLES, fmi3Float64 v[])
WITHOUT(fmi3GetShiftFraction, "clocks", VARIABLES, fmi3UInt64 a[], fmi3UInt64 b[])
WITHOUT(fmi3SetIntervalDecimal, "clocks", VARIABLES, const fmi3Float64 v[])
WITHOUT(fmi3SetShiftDecimal, "clocks", VARIABLES, const fmi3Float64 v[])
WITHOUT(fmi3SetIntervalFraction, "clocks", VARIABLES, const fmi3UInt64 a[], const fmi3UInt64 b[])
WITHOUT(fmi3SetShiftFraction, "clocks", VARIABLES, const fmi3UInt64 a[], const fmi3UInt64 b[])
WITHOUT(fmi3UpdateDiscreteStates, "events", fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e,
        fmi3Boolean *f, fmi3Float64 *t)
WITHOUT(fmi3ActivateModelPartition, "clocks", Reference clock, fmi3Float64 time)
WITHOUT(fmi3CompletedIntegratorStep, "model exchange", fmi3Boolean no_set_prior, fmi3Boolean *a, fmi3Boolean *b)
WITHOUT(fmi3SetTime, "model exchange", fmi3Float64 time)
WITHOUT(fmi3SetContinuousStates, "model exchange", const fmi3Float64 v[], size_t n)
WITHOUT(fmi3GetContinuousStateDerivatives, "model exchange", fmi3Float64 v[], size_t n)
WITHOUT(fmi3GetEventIndicators, "model exchange", fmi3Float64 v[], size_t n)
WITHOUT(fmi3GetContinuousStates, "model exchange", fmi3Float64 v[], size_t n)
WITHOUT(fmi3GetNominalsOfContinuousStates, "model exchange", fmi3Float64 v[], size_t n)
WITHOUT(fmi3GetNumberOfEventIndicators, "model exchange", size_t *n)
WITHOUT(fmi3GetNumberOfContinuousStates, "model exchange", size_t *n)
