/* FMI 2.0 for co-simulation. */
#include <string.h>
#include <stdlib.h>

#include "fmi2Functions.h"
#include "unit.h"

static fmi2Status status_of(int code) { return code ? fmi2Error : fmi2OK; }

static void report(void *instance, const char *name, int code, const char *message) {
    Instance *unit = instance;
    if (unit->logger) ((fmi2CallbackLogger)unit->logger)(unit->environment, name, fmi2Error, "logStatusError", "%s", message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    if (type != fmi2CoSimulation) return NULL;
    return unit_new(name, token, functions ? functions->componentEnvironment : NULL,
                    functions ? (void *)functions->logger : NULL, report);
}

void fmi2FreeInstance(fmi2Component c) { unit_free(c); }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean stop_defined, fmi2Real stop) {
    ((Instance *)c)->block.time = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return status_of(unit_initialize(c, ((Instance *)c)->block.time));
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return status_of(unit_started(c)); }

fmi2Status fmi2Terminate(fmi2Component c) {
    ((Instance *)c)->block.phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    unit_reset(c);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, fmi2Real values[]) {
    size_t k;
    for (k = 0; k < n; k++)
        if (unit_get(c, references[k], &values[k])) return fmi2Error;
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, const fmi2Real values[]) {
    size_t k;
    for (k = 0; k < n; k++)
        if (unit_set(c, references[k], values[k])) return fmi2Error;
    return fmi2OK;
}

#define NONE_OF(Type)                                                                                                  \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2##Type v[]) {                \
        return n ? fmi2Error : fmi2OK;                                                                                 \
    }                                                                                                                  \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2##Type v[]) {          \
        return n ? fmi2Error : fmi2OK;                                                                                 \
    }
NONE_OF(Integer)
NONE_OF(Boolean)
NONE_OF(String)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    return status_of(unit_keep(c, state, &((Instance *)c)->block, sizeof(Block)));
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    memcpy(&((Instance *)c)->block, state, sizeof(Block));
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    free(*state);
    *state = NULL;
    return fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    *size = sizeof(Block);
    return fmi2OK;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    if (size < sizeof(Block)) return fmi2Error;
    memcpy(bytes, state, sizeof(Block));
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    return status_of(unit_keep(c, state, bytes, size));
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n,
                                        const fmi2ValueReference knowns[], size_t m, const fmi2Real seed[],
                                        fmi2Real derivative[]) {
    return status_of(unit_refuse(c, WRONG_CALL, "the unit has no directional derivatives"));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                       const fmi2Integer order[], const fmi2Real values[]) {
    size_t k;
    for (k = 0; k < n; k++) {
        if (order[k] != 1) return status_of(unit_refuse(c, WRONG_CALL, "an input's derivative must be the first, got order %d", (int)order[k]));
        if (unit_set_slope(c, references[k], values[k])) return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                        const fmi2Integer order[], fmi2Real values[]) {
    return status_of(unit_refuse(c, WRONG_CALL, "the unit has no derivatives of outputs"));
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real span, fmi2Boolean no_set_prior) {
    return status_of(unit_advance(c, time, span));
}

fmi2Status fmi2CancelStep(fmi2Component c) { return status_of(unit_refuse(c, WRONG_CALL, "no step is under way")); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = ((Instance *)c)->block.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    if (kind != fmi2Terminated) return fmi2Discard;
    *value = ((Instance *)c)->block.phase == TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    return fmi2Discard;
}
