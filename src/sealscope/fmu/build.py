"""Build a functional mock-up unit (FMU): an archive of compiled equations, an interface in C and a description."""

from __future__ import annotations

import hashlib
import math
import os
import re
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Literal, NamedTuple

from sealscope.calls import checked_call
from sealscope.diagnosis.live.kernel.stream import StreamSettings
from sealscope.emit.compiler import find_compiler
from sealscope.emit.stream_program import stream_program
from sealscope.errors import InputError
from sealscope.fmu.description import format_build_description, format_description, templates
from sealscope.fmu.machine import FAILURES, RigChoice, rig_sources
from sealscope.fmu.variables import INPUTS, REFERENCES, RESULTS, SENSOR_RESULTS, Variable, variables
from sealscope.parameters import Rig, load_rig
from sealscope.parameters.parts import check_circuit_property
from sealscope.physics.rig import parameter_values
from sealscope.physics.state import STATES
from sealscope.storage.atomic import atomic_write
from sealscope.storage.plain_values import convert_type

Version = Literal[2, 3]
#: Methods of a soft sensor: the volume balance, from chamber pressures, pump's angle and piston's position.
Sensor = Literal["volume"]
#: Default limit [Pa] of the rms error of a pressure; the solver's step in an FMU is chosen to keep it.
ERROR = 1.0
#: Commands of the runs by which this step is chosen.
STEP_COMMANDS = ("3 sin(4t)", "5 sin(2t)")
#: Longest time [s] that the C compiler may take.
_COMPILE_TIMEOUT = 300.0
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
_README = f"""\
C99. To build the library for another system: cc {" ".join(_FLAGS)} -I. -o NAME.so *.c -lm
"""
#: Name of no system: of a unit that holds its sources, and no library.
SOURCE = "source"


class Platform(NamedTuple):
    """An operating system and processor on which an FMU can run."""

    target: str  # name for the C compiler
    folders: Mapping[int, str]  # by FMI version: folder of the library in the FMU's archive
    suffix: str  # of the library's file name


PLATFORMS: Mapping[str, Platform] = convert_type(
    dict[str, Platform], tomllib.loads((files("sealscope.fmu") / "platforms.toml").read_text("utf-8"))
)


def this_platform() -> str:
    """Return the name of the present system in `PLATFORMS`, such as "linux"; raise InputError if it is not there."""
    import platform

    is_arm = platform.machine().lower() in ("arm64", "aarch64")
    name = {"linux": "linux", "win32": "windows", "darwin": "macos"}.get(sys.platform, sys.platform)
    name += "-arm" if is_arm else ""
    if name not in PLATFORMS:
        raise InputError(f"platform must be one of {', '.join(PLATFORMS)}, got {name}; state the FMU's platforms")
    return name


def fmi_headers() -> Path:
    """Find the folder of FMI's C headers in the package FMPy; raise InputError if FMPy is not installed."""
    from importlib.util import find_spec

    package = find_spec("fmpy")
    if package is None or package.origin is None:
        raise InputError("an FMU needs the headers of FMI, which FMPy contains: pip install 'sealscope[fmu]'")
    return Path(package.origin).parent / "c-code"


def choose_step(rig: Rig, error: float) -> tuple[float, float]:
    """Choose the solver's step with which the rms error of the pressures is at most `error` [Pa].

    A run of 4 s from mid-stroke is simulated under each of `STEP_COMMANDS`. Returns the shortest step [s] that these
    runs chose, and the largest of their estimated errors [Pa].
    """
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.integrate import integrate_run

    experiments = (Experiment.of(rig=rig, command=command, duration=4.0, error=error) for command in STEP_COMMANDS)
    runs = [integrate_run(experiment, ()) for experiment in experiments]
    return min(run.step for run in runs), max(run.error for run in runs)


class MockUp(NamedTuple):
    """The code and data of a functional mock-up unit (FMU), to be compiled and archived."""

    summary: str  # one line that describes the FMU
    modules: Mapping[str, str]  # C sources of what it computes, by name of the file
    variable_list: tuple[Variable, ...]
    values: tuple[float, ...]  # initial values of the parameters, in the order of the code
    n_inputs: int
    n_results: int
    n_states: int  # or doubles in the memory of a soft sensor
    step: float  # longest step of the solver, or sampling interval of a soft sensor [s]
    failures: Mapping[int, str]  # messages, by the code that a function returns

    @property
    def token(self) -> str:
        """Hash (32 hex digits) by which the compiled library recognises its XML description."""
        texts = [self.summary, str(self.variable_list), *self.modules.values()]
        return hashlib.sha256("".join(texts).encode()).hexdigest()[:32]

    def write(self, path: Path, version: Version, platforms: Sequence[str]) -> None:
        """Write the archive for FMI `version` with a library for each platform; raise InputError if compiling fails."""
        identifier = re.sub(r"\W|^(?=\d)", "_", path.stem, flags=re.ASCII)  # must be valid in C
        with tempfile.TemporaryDirectory(prefix="sealscope-fmu-") as folder, atomic_write(path) as temporary:
            source_folder = Path(folder)
            sources = self._write_sources(source_folder, version)
            compiled = [source.name for source in sources if source.suffix == ".c"]
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                xml = format_description(version, identifier, self.token, self.summary, self.variable_list, compiled)
                archive.writestr("modelDescription.xml", xml)
                if version == 3:
                    archive.writestr("sources/buildDescription.xml", format_build_description(identifier, compiled))
                for system in platforms:
                    if system == SOURCE:
                        continue
                    target = f"binaries/{PLATFORMS[system].folders[version]}/{identifier}{PLATFORMS[system].suffix}"
                    archive.writestr(target, self._compile_library(source_folder, system, compiled))
                for source in sources:
                    archive.write(source, f"sources/{source.name}")

    def _write_sources(self, folder: Path, version: Version) -> list[Path]:
        """Write the FMU's sources (C, with the headers of FMI `version`) to a folder; return the files' paths."""
        interface = files("sealscope.fmu") / "c"
        # indices in `values`; those of inputs and outputs fall outside its range
        value_indices = {variable.reference - REFERENCES["value"] for variable in self.variable_list}
        # 1 for a parameter that is a variable of the FMU, 0 for one that keeps its value
        present = [int(k in value_indices) for k in range(len(self.values))]
        config = templates().get_template("config.h.j2").render(unit=self, references=REFERENCES, present=present)
        texts = {name: (interface / name).read_text("utf-8") for name in ("unit.c", "unit.h", f"fmi{version}.c")}
        texts |= {path.name: path.read_text("utf-8") for path in fmi_headers().glob(f"fmi{version}*.h")}
        texts |= {"config.h": config, **self.modules, "README.txt": _README}
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        return [folder / name for name in texts]

    def _compile_library(self, folder: Path, system: str, sources: Sequence[str]) -> bytes:
        """Compile C files in `folder` to a library for `system`; return its bytes, or raise InputError."""
        platform = PLATFORMS[system]
        compiler = find_compiler()
        output = folder / f"{system}{platform.suffix}"
        target = ["-target", platform.target] if compiler.cross_compiles else []
        inputs = [str(folder / name) for name in sources]
        command = [*compiler.command, *target, *_FLAGS, f"-I{folder}", "-o", str(output), *inputs, "-lm"]
        rule = f"the C compiler ({' '.join(compiler.command)}) must build the unit for {system}"
        try:
            process = subprocess.run(
                command, capture_output=True, encoding="utf-8", errors="replace", timeout=_COMPILE_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise InputError(f"{rule} within {_COMPILE_TIMEOUT:g} s, got none by then") from None
        except OSError as error:
            raise InputError(f"{rule}, got {error.strerror or error}") from None
        if process.returncode or not output.is_file():
            messages = " ".join(process.stderr[-500:].split())
            raise InputError(f"{rule}, got {messages or f'none, and status {process.returncode}'}")
        return output.read_bytes()


@checked_call
def write_fmu(
    path: str | os.PathLike[str],
    *,
    rig: Rig | str | os.PathLike[str] = "thesis",
    fmi: Version = 2,
    platforms: Sequence[str] | None = None,
    error: float = ERROR,
    step: float | None = None,
) -> tuple[Variable, ...]:
    """Write a functional mock-up unit (FMU) that simulates a rig in co-simulation.

    The FMU contains the compiled equations of `simulate`, and needs no Python. Its inputs are the command, a leak,
    external leakage and a load, its outputs states, flows and powers; the parameters of the rig's parts can be tuned.

    Parameters
    ----------
    path : str or path-like
        File to write (.fmu).
    rig : Rig, str or path-like, optional
        A rig, the name of a packaged one, or the path of a TOML file.
    fmi : {2, 3}, optional
        Version of the Functional Mock-up Interface.
    platforms : sequence of str, optional
        Systems on which the FMU can run: "linux", "windows", "macos", and for FMI 3 also "macos-arm" and "linux-arm";
        by default the present one. Others need the compiler that ``pip install 'sealscope[fmu]'`` installs. "source"
        alone: no library, only the C sources that each unit holds, for importers that compile.
    error : float, optional
        Largest rms error of a pressure [Pa]; the solver's step is chosen to keep it.
    step : float, optional
        Longest step of the solver [s], instead of one chosen for `error`.

    Returns
    -------
    tuple of Variable
        The FMU's variables: name, unit, causality, initial value.

    Raises
    ------
    InputError
        An argument breaks a rule, the rig is not pump-controlled, or there is no compiler.

    Examples
    --------
    >>> import sealscope as ss
    >>> variables = ss.write_fmu("eha.fmu", step=5e-4)  # doctest: +SKIP
    >>> [variable.name for variable in variables if variable.causality == "input"]  # doctest: +SKIP
    ['u', 'G', 'C', 'F', 'G_ext_A', 'G_ext_B']
    """
    path = Path(path)
    chosen_platforms = _choose_platforms(path, fmi, platforms)
    machine = load_rig(rig)
    check_circuit_property("a unit", machine.name, machine.circuit, "pump_feeds_chambers")
    if step is None:
        step, found_error = choose_step(machine, error)
        accuracy = f"steps of at most {step:.3g} s, by which pressures are off by {found_error:.2g} Pa rms"
    elif 0 < step < math.inf:
        accuracy = f"steps of at most {step:.3g} s"
    else:
        raise InputError(f"step must be > 0 s, got {step}")
    unit = MockUp(
        summary=f"{machine.title}; {accuracy}",
        modules=rig_sources(RigChoice.from_rig(machine), machine.title),
        variable_list=tuple(variables(machine, step)),
        values=parameter_values(machine),
        n_inputs=len(INPUTS),
        n_results=len(RESULTS),
        n_states=len(STATES),
        step=step,
        failures=FAILURES,
    )
    unit.write(path, fmi, chosen_platforms)
    return unit.variable_list


@checked_call
def write_sensor_fmu(
    path: str | os.PathLike[str],
    *,
    sensor: Sensor = "volume",
    rig: Rig | str | os.PathLike[str] = "thesis",
    rate: float = 500.0,
    flow: str = "theta",
    fmi: Version = 2,
    platforms: Sequence[str] | None = None,
) -> tuple[Variable, ...]:
    """Write a functional mock-up unit (FMU) that estimates the leakage from measurements, a soft sensor.

    From measured pressures, pump's flow and position, it estimates the leakage of pump and piston together in blocks
    of 3 s. The FMU contains the C99 that controllers run, too (`export_controller`). It needs no Python. Its outputs:

    - the mean leakage of the last blocks, at most 20, with a 95 % interval [m^3/s];
    - an alarm at one false alarm in 1000 h, the leak since its onset with a 95 % interval, and without an alarm the
      bound of a leak [m^3/s];
    - further numbers, such as the leakage conductance.

    Parameters
    ----------
    path : str or path-like
        File to write (.fmu).
    sensor : {"volume"}, optional
        Method: the volume balance, which reads chamber pressures, the pump's flow and the piston's position.
    rig : Rig, str or path-like, optional
        The assumed machine: a rig, the name of a packaged one, or the path of a TOML file.
    rate : float, optional
        Sampling rate of the inputs [Hz], at least 16; it does not depend on the communication steps.
    flow : {"theta", "omega", "q_pump"}, optional
        Channel that gives the pump's flow: its angle, its speed, or a flow meter.
    fmi : {2, 3}, optional
        Version of the Functional Mock-up Interface.
    platforms : sequence of str, optional
        Systems on which the FMU can run, as in `write_fmu`.

    Returns
    -------
    tuple of Variable
        The FMU's variables: name, unit, causality, initial value.

    Raises
    ------
    InputError
        An argument breaks a rule, no controller computes the rig's balance, the pump's displacement is not stated, or
        there is no compiler.

    Examples
    --------
    >>> import sealscope as ss
    >>> variables = ss.write_sensor_fmu("leak.fmu", sensor="volume")  # doctest: +SKIP
    >>> [variable.name for variable in variables if variable.causality == "input"]  # doctest: +SKIP
    ['p_A', 'p_B', 'theta', 'x']
    """
    from sealscope.fmu.sensor import FAILURES, memory_size, sensor_sources
    from sealscope.fmu.sensor import variables as sensor_variables

    path = Path(path)
    chosen_platforms = _choose_platforms(path, fmi, platforms)
    if sensor != "volume":
        raise InputError(f"sensor must be volume, got {sensor!r}")
    machine = load_rig(rig)
    program = stream_program(StreamSettings.from_rig(machine, float(rate), flow))
    unit = MockUp(
        summary=f"soft sensor of leakage (volume balance of {flow} and x at {rate:g} Hz) for {machine.title}",
        modules=sensor_sources(program, machine.title),
        variable_list=tuple(sensor_variables(machine, program.settings.channels)),
        values=parameter_values(machine),
        n_inputs=len(program.settings.channels),
        n_results=len(SENSOR_RESULTS),
        n_states=memory_size(program),
        step=1.0 / rate,
        failures=FAILURES,
    )
    unit.write(path, fmi, chosen_platforms)
    return unit.variable_list


def _choose_platforms(path: str | os.PathLike[str], fmi: int, platforms: Sequence[str] | None) -> tuple[str, ...]:
    """Choose the platforms of an FMU, `platforms` or else the present one, and check that the FMU can be built.

    Raises InputError if `path` does not end in .fmu, if the FMI version or a platform is not supported, or if the
    compiler found cannot compile for another platform than the present one.
    """
    if Path(path).suffix != ".fmu":
        raise InputError(f"a unit's file must end in .fmu, got {path}")
    if fmi not in (2, 3):
        raise InputError(f"fmi must be 2 or 3, got {fmi!r}")
    chosen_platforms = tuple(dict.fromkeys(platforms or (this_platform(),)))
    for name in chosen_platforms:
        if name == SOURCE:
            continue
        if name not in PLATFORMS or fmi not in PLATFORMS[name].folders:
            platform_names = ", ".join(key for key, platform in PLATFORMS.items() if fmi in platform.folders)
            raise InputError(f"a platform of FMI {fmi} must be one of {platform_names}, {SOURCE}, got {name!r}")
        if name != this_platform() and not find_compiler().cross_compiles:
            raise InputError(f"a unit for {name} needs a compiler for it: pip install 'sealscope[fmu]'")
    return chosen_platforms
