"""A unit against `simulate`: the same laws, run by an importer (FMPy) and by a master in C."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.emit.compiler import find_compiler
from sealscope.fmu.build import PLATFORMS, this_platform
from sealscope.simulation.commands import sampled_signal
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run

pytestmark = pytest.mark.slow
fmpy = pytest.importorskip("fmpy", reason="FMPy runs the units: pip install 'sealscope[fmu]'")

COMPILER = shutil.which("gcc")
STEPS = {"single-rod-eha": 1.25e-4}
CHANNELS = ("p_A", "p_B", "x", "theta", "q_leak")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("units")


@pytest.fixture(
    scope="module",
    params=["thesis", *(pytest.param(name, marks=pytest.mark.long) for name in ("single-rod-eha", "throttled"))],
)
def rig(request):
    if request.param == "throttled":
        return ss.load_rig("thesis").with_overrides({"line.orifices": "present", "line.closed_A": 0.5})
    return ss.load_rig(request.param)


@dataclass
class Unit:
    """An instance of a unit of version 2 or 3, with the calls of both under one name."""

    path: str
    version: int

    def __post_init__(self):
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self.description = fmpy.read_model_description(str(self.path))
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        token = self.description.guid if self.version == 2 else self.description.instantiationToken
        self.unit = (FMU2Slave if self.version == 2 else FMU3Slave)(
            guid=token,
            unzipDirectory=fmpy.extract(str(self.path)),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="unit",
        )
        self.unit.instantiate()

    def start(self, **values):
        if self.version == 2:
            self.unit.setupExperiment(startTime=0.0)
        self.set(**values)
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()
        return self

    def set(self, **values):
        put = self.unit.setReal if self.version == 2 else self.unit.setFloat64
        put([self.references[name.replace("__", ".")] for name in values], list(values.values()))

    def get(self, *names):
        take = self.unit.getReal if self.version == 2 else self.unit.getFloat64
        return np.array(take([self.references[name] for name in names]))

    def slope(self, name, value):
        reference, order = (ctypes.c_uint * 1)(self.references[name]), (ctypes.c_int * 1)(1)
        self.unit.fmi2SetRealInputDerivatives(self.unit.component, reference, 1, order, (ctypes.c_double * 1)(value))

    def step(self, time, span):
        return self.unit.doStep(time, span)

    def free(self):
        self.unit.terminate()
        self.unit.freeInstance()


def run(unit, t, u, G):
    """Rows of `CHANNELS` at every communication point; the command linear between them in version 2, else held."""
    rows = np.empty((t.size - 1, len(CHANNELS)))
    unit.start()
    for k in range(t.size - 1):
        span = t[k + 1] - t[k]
        unit.set(u=u[k], G=G[k])
        if unit.version == 2:
            unit.slope("u", (u[k + 1] - u[k]) / span)
        rows[k] = unit.get(*CHANNELS)
        unit.step(t[k], span)
    unit.free()
    return rows


def test_a_unit_runs_as_simulate_does(rig, folder):
    path, span = folder / f"{rig.name}.fmu", 1e-3
    seconds = 60.0 if rig == ss.load_rig("thesis") else 25.0
    ss.write_fmu(path, rig=rig, step=STEPS.get(rig.name, 2.5e-4))
    t = np.arange(round(seconds / span) + 1) * span
    u, G = 3.0 * np.sin(2.0 * t), np.where(t > 20.0 - 1e-9, 6.1e-13, 0.0)
    ours = run(Unit(path, 2), t, u, G)
    extended = np.r_[t, t[-1] + 1.0], np.r_[u, u[-1]]
    same = Experiment.of(
        rig=rig,
        command=sampled_signal(*extended),
        leak="G = 6.1e-13 from 20 s",
        duration=seconds,
        rate=1 / span,
        step=STEPS.get(rig.name, 2.5e-4),
    )
    path_ = integrate_run(same, same.leaks)
    every = round(span * round((path_.t.size - 1) / path_.t[-1]))
    theirs = np.stack([path_[name][::every][: t.size - 1] for name in CHANNELS], axis=1)
    worst = np.abs(ours - theirs).max(axis=0)
    assert (worst[:2] < 1.0).all(), worst  # asked: 1 Pa
    assert worst[2] < 1e-9, worst  # asked: 1e-9 m


@pytest.mark.parametrize("version", [2, 3])
def test_a_unit_passes_the_checks_of_an_importer_and_keeps_its_state(folder, version):
    from fmpy.validation import validate_fmu

    path = folder / f"eha{version}.fmu"
    variables = ss.write_fmu(path, fmi=version, step=5e-4)
    inputs = [variable.name for variable in variables if variable.causality == "input"]
    assert inputs == ["u", "G", "C", "F", "G_ext_A", "G_ext_B"]  # as its example says
    assert validate_fmu(str(path)) == []
    unit = Unit(path, version).start(u=3.0, G=1e-12)
    for k in range(20):
        unit.step(k * 1e-3, 1e-3)
    state = unit.unit.getFMUState()
    bytes_ = unit.unit.serializeFMUState(state)
    after = []
    for again in (state, unit.unit.deserializeFMUState(bytes_)):
        unit.unit.setFMUState(again)
        for k in range(20, 60):
            unit.step(k * 1e-3, 1e-3)
        after.append(unit.get("p_A", "p_B", "x", "theta", "P_electric"))
    assert (after[0] == after[1]).all()  # to the bit
    unit.unit.setFMUState(state)
    with pytest.raises(Exception, match=r"doStep|DoStep"):
        unit.step(0.5, 1e-3)  # time must go on where it was
    with pytest.raises(Exception, match=r"setReal|SetReal|SetFloat64"):
        unit.set(start_position=0.1)  # fixed after the start
    unit.free()


def test_both_versions_give_the_same_numbers(folder):
    paths = [folder / "two.fmu", folder / "three.fmu"]
    rows = []
    for version, path in zip((2, 3), paths, strict=True):
        ss.write_fmu(path, fmi=version, step=5e-4)
        unit = Unit(path, version).start(u=2.0, F=50.0)
        for k in range(100):
            unit.step(k * 1e-3, 1e-3)
        rows.append(unit.get("p_A", "p_B", "x", "omega", "P_mechanical"))
        unit.free()
    assert (rows[0] == rows[1]).all()


def test_a_tuned_parameter_is_the_parameter_of_the_rig(folder):
    path = folder / "tuned.fmu"
    ss.write_fmu(path, step=5e-4)
    unit = Unit(path, 2).start(u=3.0, friction__F_v=900.0, pump__q_b=6e-6, cylinder__V=3e-4)
    for k in range(1000):
        unit.step(k * 1e-3, 1e-3)
    ours = unit.get("p_A", "x", "theta")
    same = Experiment.of(
        set={"F_v": 900.0, "q_b": 6e-6, "cylinder.V": 3e-4}, command="step 3 at 0 s", duration=1.1, step=5e-4, rate=1000
    )
    theirs = integrate_run(same, ())
    row = int(np.argmin(np.abs(theirs.t - 1.0)))
    expected = [theirs[name][row] for name in ("p_A", "x", "theta")]
    assert ours == pytest.approx(expected, rel=1e-6)
    unit.free()


def test_a_thousand_instances_live_and_die_without_a_leak_of_memory(folder):
    resource = pytest.importorskip("resource")
    path = folder / "many.fmu"
    ss.write_fmu(path, step=5e-4)
    first = Unit(path, 2).start(u=1.0)
    library, calls = first.unit.dll, first.unit
    token, callbacks = first.description.guid.encode(), calls.callbacks
    instantiate, free = library.fmi2Instantiate, library.fmi2FreeInstance
    instantiate.restype, free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    setup, enter, leave = (
        library.fmi2SetupExperiment,
        library.fmi2EnterInitializationMode,
        library.fmi2ExitInitializationMode,
    )
    setup.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_double, ctypes.c_double, ctypes.c_int, ctypes.c_double]
    step = library.fmi2DoStep
    step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int]
    enter.argtypes = leave.argtypes = [ctypes.c_void_p]

    def live(count):
        units = [instantiate(b"many", 1, token, b"", ctypes.byref(callbacks), 0, 0) for _ in range(count)]
        assert all(units)
        for unit in units:
            assert setup(unit, 0, 0.0, 0.0, 0, 0.0) == enter(unit) == leave(unit) == step(unit, 0.0, 1e-3, 0) == 0
        for unit in units:
            free(unit)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = live(1000)
    for _ in range(5):
        after = live(1000)
    assert after - before < 500  # KiB; a thousand leaked instances would be 2 MB a turn
    assert instantiate(b"other", 1, b"another token", b"", ctypes.byref(callbacks), 0, 0) is None
    first.free()


MASTER = r"""
#include <dlfcn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include "fmi2Functions.h"
#define TAKE(name, function) function##TYPE *name = (function##TYPE *)dlsym(library, #function);
static void logger(void *e, fmi2String n, fmi2Status s, fmi2String c, fmi2String m, ...) {
    (void)e; (void)s; (void)c; va_list a; va_start(a, m); printf("%s: ", n); vprintf(m, a); printf("\n"); va_end(a);
}
int main(int argc, char **argv) {
    void *library = dlopen(argv[1], RTLD_NOW);
    fmi2CallbackFunctions calls = {logger, calloc, free, NULL, NULL};
    fmi2ValueReference u = atoi(argv[3]), outputs[2] = {atoi(argv[4]), atoi(argv[5])};
    fmi2Real volts = atof(argv[6]), span = atof(argv[7]), values[2];
    int k, steps = atoi(argv[8]);
    (void)argc;
    if (!library) return 1;
    TAKE(make, fmi2Instantiate)
    TAKE(setup, fmi2SetupExperiment)
    TAKE(enter, fmi2EnterInitializationMode)
    TAKE(leave, fmi2ExitInitializationMode)
    TAKE(set, fmi2SetReal)
    TAKE(get, fmi2GetReal)
    TAKE(step, fmi2DoStep)
    TAKE(drop, fmi2FreeInstance)
    fmi2Component c = make("c", fmi2CoSimulation, argv[2], "", &calls, fmi2False, fmi2False);
    if (!c) return 2;
    if (setup(c, fmi2False, 0, 0, fmi2False, 0) || enter(c) || leave(c) || set(c, &u, 1, &volts)) return 3;
    for (k = 0; k < steps; k++)
        if (step(c, k * span, span, fmi2True)) return 4;
    if (get(c, outputs, 2, values)) return 5;
    printf("%.17g %.17g\n", values[0], values[1]);
    volts = 0.0 / 0.0;
    if (set(c, &u, 1, &volts) != fmi2Error) return 6;
    drop(c);
    return 0;
}
"""


@pytest.mark.skipif(
    shutil.which("gcc") is None or this_platform() != "linux", reason="a master in C needs gcc on Linux"
)
@pytest.mark.parametrize(
    ("kind", "given", "value", "span", "steps", "outputs"),
    [
        ("machine", "u", 3.0, 1e-3, 1000, ("p_A", "x")),
        ("sensor", "p_A", 1e5, 2e-3, 20_000, ("blocks", "misfit")),
    ],
)
def test_a_master_in_c_runs_the_unit(kind, given, value, span, steps, outputs, folder, tmp_path):
    path = folder / "c.fmu"
    if kind == "machine":
        ss.write_fmu(path, step=5e-4)
    else:
        ss.write_sensor_fmu(path)
    unit = Unit(path, 2).start(**{given: value})
    for k in range(steps):
        unit.step(k * span, span)
    place = fmpy.extract(str(path))
    (tmp_path / "master.c").write_text(MASTER)
    headers = f"-I{place}/sources"
    subprocess.run(["gcc", headers, tmp_path / "master.c", "-ldl", "-o", tmp_path / "master"], check=True, timeout=60)
    references = [str(unit.references[name]) for name in (given, *outputs)]
    call = [tmp_path / "master", f"{place}/binaries/linux64/c.so", unit.description.guid, *references]
    done = subprocess.run(
        [*call, repr(value), repr(span), str(steps)], capture_output=True, text=True, timeout=60, check=True
    )
    numbers, refusal = done.stdout.splitlines()
    ours = [float(word) for word in numbers.split()]
    assert ours == list(unit.get(*outputs))
    assert any(ours) == (kind == "machine")  # of a machine at standstill a sensor estimates no block
    assert refusal.startswith("c: a value must be finite")
    unit.free()


@pytest.mark.skipif(COMPILER is None or this_platform() != "linux", reason="sources are compiled by gcc on Linux")
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("write", [partial(ss.write_fmu, step=5e-4), partial(ss.write_sensor_fmu, rate=100.0)])
def test_the_sources_of_a_unit_compile_to_the_same_numbers(write, version, folder, tmp_path):
    """A unit of sources alone, compiled as its description says, equals that with a library to the bit."""
    library, sources = folder / f"library{version}.fmu", tmp_path / "sources.fmu"
    write(library, fmi=version)
    write(sources, fmi=version, platforms=["source"])
    place = Path(fmpy.extract(str(sources)))
    assert not (place / "binaries").exists()
    description = fmpy.read_model_description(str(sources))
    assert description.coSimulation.needsExecutionTool is False
    (files,) = description.buildConfigurations[0].sourceFileSets
    assert set(files.sourceFiles) == {path.name for path in (place / "sources").glob("*.c")}
    target = place / "binaries" / PLATFORMS["linux"].folders[version]
    target.mkdir(parents=True)
    flags = ["-std=c99", "-O2", "-Wall", "-Werror", "-ffp-contract=off", "-fPIC", "-shared"]
    output = target / f"{description.coSimulation.modelIdentifier}.so"
    subprocess.run(
        [COMPILER, *flags, "-o", output, *files.sourceFiles, "-lm"], cwd=place / "sources", check=True, timeout=120
    )
    shutil.make_archive(str(tmp_path / "compiled"), "zip", place)
    compiled = (tmp_path / "compiled.zip").rename(tmp_path / "compiled.fmu")
    random, rows = np.random.default_rng(5), []
    readings = 1e6 * random.standard_normal((1000, 2)).cumsum(axis=0)
    for path in (library, compiled):
        unit = Unit(path, version).start()
        names = [v.name for v in unit.description.modelVariables if v.causality == "input"]
        outputs = [v.name for v in unit.description.modelVariables if v.causality == "output"]
        for k, (first, second) in enumerate(readings):
            unit.set(**{names[0]: math.sin(0.01 * k) if "u" in names else first, names[1]: abs(second) * 1e-18})
            unit.step(k * 1e-2, 1e-2)
        rows.append(unit.get(*outputs))
        unit.free()
    assert np.array_equal(rows[0], rows[1], equal_nan=True)


@pytest.mark.long
@pytest.mark.skipif(
    not find_compiler().cross_compiles, reason="other systems need the compiler of pip install 'sealscope[fmu]'"
)
@pytest.mark.parametrize("write", [partial(ss.write_fmu, step=5e-4), ss.write_sensor_fmu])
def test_units_are_built_for_other_systems(write, folder):
    import zipfile

    marks = {"linux": b"\x7fELF", "linux-arm": b"\x7fELF", "windows": b"MZ", "macos": b"\xcf\xfa\xed\xfe"}
    path = folder / "all.fmu"
    write(path, fmi=3, platforms=list(PLATFORMS))
    with zipfile.ZipFile(path) as archive:
        for name, platform in PLATFORMS.items():
            library = archive.read(f"binaries/{platform.folders[3]}/all{platform.suffix}")
            assert library.startswith(marks.get(name, marks["macos"]))
            assert b"fmi3DoStep" in library
