"""Somebody else's machine as a unit: recorded by the instruments, diagnosed; what is refused."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from importlib.resources import files

import numpy as np
import pytest

import sealscope as ss
from sealscope.errors import InputError, SimulationFailed
from sealscope.fmu.build import fmi_headers, this_platform
from sealscope.simulation.simulate import simulate_experiment

fmpy = pytest.importorskip("fmpy", reason="FMPy runs the units: pip install 'sealscope[fmu]'")
pytestmark = pytest.mark.slow

#: Two chambers of constant volume, a piston with Coulomb friction, a pump with a first-order drive: written for this
#: test with names, units and numbers of its own; pressures in bar, position in mm, angle in degrees.
PLANT = r"""
#include <math.h>
#include <stdint.h>
static void rates(const double *v, const double *in, const double *y, double *dy) {
    double area = 1.1e-3, mass = 240.0, stiff = 1.1e9 / 6.0e-4, displacement = 1.2e-6;
    double leak = in[1] * (y[3] - y[4]);
    (void)v;
    dy[0] = (30.0 * in[0] - y[0]) / 0.02;
    dy[1] = y[0];
    dy[2] = y[5];
    dy[3] = stiff * (displacement * y[0] - area * y[5] - leak);
    dy[4] = -dy[3];
    dy[5] = ((y[3] - y[4]) * area - 900.0 * y[5] - 120.0 * tanh(y[5] / 1e-3)) / mass;
}
void sealscope_start(int64_t *code, const double *v, const double *in, double x_0, double *y) {
    (void)v, (void)in;
    y[0] = y[1] = y[5] = 0.0;
    y[2] = x_0;
    y[3] = y[4] = 8e5;
    *code = 0;
}
void sealscope_report(const double *v, const double *in, double *y, double *out) {
    (void)v, (void)in;
    out[0] = y[3] / 1e5;
    out[1] = y[4] / 1e5;
    out[2] = y[2] * 1e3;
    out[3] = y[1] * 180.0 / 3.14159265358979323846;
    out[4] = 40.0;
    out[5] = 1.2e-6 * y[0] * 6e4;
}
void sealscope_advance(int64_t *code, const double *v, const double *in, const double *slopes, double *y,
                       double span, int64_t n) {
    double h = span / (double)n, k[4][6], z[6];
    int64_t step;
    int m, s;
    (void)slopes;
    for (step = 0; step < n; step++) {
        rates(v, in, y, k[0]);
        for (s = 1; s < 4; s++) {
            for (m = 0; m < 6; m++) z[m] = y[m] + h * (s == 3 ? 1.0 : 0.5) * k[s - 1][m];
            rates(v, in, z, k[s]);
        }
        for (m = 0; m < 6; m++) y[m] += h / 6.0 * (k[0][m] + 2.0 * k[1][m] + 2.0 * k[2][m] + k[3][m]);
    }
    *code = in[0] > 9.5 ? 1 : 0;
}
"""
CONFIG = """
#define N_STATES 6
#define N_VALUES 1
#define N_INPUTS 2
#define N_RESULTS 6
#define INPUT_BASE 1
#define VALUE_BASE 1000
#define RESULT_BASE 2000
#define START_POSITION 3000
#define STEP 3001
#define TOKEN "plant"
#define START_STEP 1e-4
#define VALUES_AT_START {0.0}
#define VALUES_PRESENT {0}
#define FAILURES {"drive overloaded"}
"""
VARIABLES = {
    "drive.voltage": (1, "input", "mV"),
    "seal.conductance": (2, "input", None),
    "cap.pressure": (2000, "output", "bar"),
    "rod.pressure": (2001, "output", "bar"),
    "piston.travel": (2002, "output", "mm"),
    "motor.angle": (2003, "output", "deg"),
    "oil.temperature": (2004, "output", "degC"),
    "pump.flow": (2005, "output", "L/min"),
}
MAP = {
    "u": "drive.voltage", "G": "seal.conductance", "p_A": "cap.pressure", "p_B": "rod.pressure", "x": "piston.travel",
    "theta": "motor.angle",
}  # fmt: skip


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    """The plant as a unit; its command is in mV, so that units are converted on the way in, too."""
    if shutil.which("gcc") is None or this_platform() != "linux":
        pytest.skip("the plant of this test needs gcc on Linux")
    place = tmp_path_factory.mktemp("plant")
    layer = files("sealscope.fmu") / "c"
    (place / "plant.c").write_text(PLANT.replace("30.0 * in[0]", "30.0 * in[0] / 1e3").replace("9.5", "9500.0"))
    (place / "config.h").write_text(CONFIG)
    for name in ("unit.c", "unit.h", "fmi2.c"):
        (place / name).write_text((layer / name).read_text())
    include = [f"-I{place}", f"-I{fmi_headers()}"]
    sources = [place / name for name in ("plant.c", "unit.c", "fmi2.c")]
    library = place / "plant.so"
    subprocess.run(["gcc", "-O2", "-fPIC", "-shared", *include, *sources, "-lm", "-o", library], check=True, timeout=60)
    held = "".join(
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" variability="continuous"'
        + (' initial="calculated"' if causality == "output" else "")
        + "><Real"
        + (f' unit="{unit}"' if unit else "")
        + (' start="0"' if causality == "input" else "")
        + "/></ScalarVariable>"
        for name, (reference, causality, unit) in VARIABLES.items()
    )
    outputs = "".join(f'<Unknown index="{k}"/>' for k, v in enumerate(VARIABLES.values(), 1) if v[1] == "output")
    units = "".join(f'<Unit name="{unit}"/>' for unit in ("mV", "bar", "mm", "deg", "degC", "L/min"))
    path = place / "plant.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(library, "binaries/linux64/plant.so")
        archive.writestr(
            "modelDescription.xml",
            '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="plant" guid="plant">'
            f'<CoSimulation modelIdentifier="plant"/><UnitDefinitions>{units}</UnitDefinitions>'
            f"<ModelVariables>{held}</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs>"
            f"<InitialUnknowns>{outputs}</InitialUnknowns></ModelStructure></fmiModelDescription>",
        )
    return path


@pytest.mark.long
def test_a_foreign_unit_is_recorded_and_diagnosed(plant, tmp_path):
    maps = [word for channel, name in MAP.items() for word in ("--map", f"{channel}={name}")]
    common = ("--fmu", plant, "--command", "2 sin(3t)", "--duration", "120", *maps)
    for name, leak in (("healthy", ()), ("leaking", ("--leak", "G = 2e-11 from 60 s"))):
        words = ["simulate", *common, *leak, "-o", tmp_path / f"{name}.nc"]
        done = subprocess.run(
            [sys.executable, "-m", "sealscope", *words], capture_output=True, text=True, timeout=120, check=True
        )
        assert "60000 samples at 500 Hz" in " ".join(done.stdout.split())
        assert done.stderr == ""
    recording = ss.read(tmp_path / "leaking.nc")
    assert set(recording.channels) == {"u", "p_A", "p_B", "x", "theta", "omega"}  # no p_1, p_2, q_leak
    assert recording.provenance["unit"]["name"] == "plant"
    assert 7.5e5 < recording["p_A"].mean() < 8.5e5
    healthy, leaking = ss.diagnose(ss.read(tmp_path / "healthy.nc")), ss.diagnose(recording)
    assert healthy.verdict == "no leak"
    assert leaking.verdict == "leak"
    assert leaking.onset_s == pytest.approx(60.0, abs=2.0)


def test_what_no_instrument_reads_is_recorded_as_the_unit_gives_it(plant):
    experiment = ss.Experiment.of(command="2 sin(3t)", duration=2.0)
    recording = ss.record_fmu(plant, experiment, map=MAP | {"T_oil": "oil.temperature", "q_pump": "pump.flow"})
    np.testing.assert_allclose(recording["T_oil"], 313.15, rtol=1e-12)
    assert (recording.units["T_oil"], recording.units["q_pump"]) == ("K", "m^3/s")
    turned = 1.2e-6 * np.gradient(recording["theta"]) * recording.rate  # of whole counts
    np.testing.assert_allclose(np.cumsum(recording["q_pump"] - turned) / recording.rate, 0.0, atol=1e-8)


def test_a_unit_of_our_own_is_recorded_as_simulate_records(tmp_path):
    path = tmp_path / "eha.fmu"
    ss.write_fmu(path)
    experiment = ss.Experiment.of(command="3 sin(4t)", leak="G = 2e-12 from 5 s", duration=10.0, seed=3, error=1.0)
    ours, theirs = ss.record_fmu(path, experiment), simulate_experiment(experiment).recording
    assert list(ours.channels) == list(theirs.channels)
    for name in ("p_A", "p_B", "x", "theta"):
        apart = abs(ours[name] - theirs[name])
        count = abs(np.diff(np.unique(theirs[name]))).min()  # of the converter, or of the encoder
        assert apart.max() <= 1.01 * count
        assert (apart > 0.0).mean() < 0.01


@pytest.mark.parametrize(("rate", "frequency"), [(100.0, 398.0), (2000.0, 1990.0)])
def test_a_command_faster_than_the_samples_is_no_slow_motion(plant, rate, frequency):
    """The plant's drive turns by 30 times the integral of the command, whose mean over time is amplitude/omega."""
    omega = 2.0 * np.pi * frequency
    experiment = ss.Experiment.of(command=f"2 sin({omega:.6f}t)", duration=2.0, rate=rate)
    theta = ss.record_fmu(plant, experiment, map=MAP)["theta"]
    count = 2.0 * np.pi / experiment.rig.sensors.theta.counts
    settled = theta[theta.size // 2 :]
    np.testing.assert_allclose(settled, 30.0 * 2.0 / omega, rtol=0.1, atol=count)  # held, it would turn by some radians


def test_what_a_unit_cannot_do_is_one_line(plant, tmp_path):
    def refused(error=InputError, path=plant, map=MAP, **options):
        with pytest.raises(error) as caught:
            ss.record_fmu(path, ss.Experiment.of(**{"duration": 1.0, "command": "2 sin(3t)"} | options), map=map)
        return str(caught.value)

    assert "an FMU's leak must be a conductance" in refused(leak="0.01 L/min")
    assert "the experiment needs the input F (load against +x" in refused(load="1 kN")
    assert "an FMU must have the outputs p_A and p_B, got cap.pressure" in refused(map={"u": "drive.voltage"})
    assert "has no variable 'drive.volts'; did you mean drive.voltage?" in refused(map={"u": "drive.volts"})
    assert "may have faults and drifts of sensors only" in refused(fault="friction +20 %")
    assert "an FMU must have a command, not a target" in refused(
        command="position 50 mm sin(2t)", rig="thesis-closed-loop"
    )
    assert "the unit plant.fmu failed" in refused(SimulationFailed, command="step 9.9 at 0.5 s")
    broken = tmp_path / "broken.fmu"
    broken.write_bytes(b"PK no archive")
    assert "cannot read the unit" in refused(path=broken)
