"""Build a unit: machine code of the laws, a thin layer in C around it, a description, one archive."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
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
from sealscope.diagnosis.inference.rows.weak_form import STRIDE
from sealscope.diagnosis.inference.volumes.detector import RESOLVED
from sealscope.errors import InputError
from sealscope.fmu.description import description, templates
from sealscope.fmu.machine import FAILURES, Choice, code, object_code
from sealscope.fmu.variables import INPUTS, REFERENCES, RESULTS, SENSOR_RESULTS, Variable, variables
from sealscope.parameters import Rig, load_rig
from sealscope.physics.rig import values_of
from sealscope.physics.state import STATES
from sealscope.storage.atomic import atomic_write
from sealscope.storage.plain_values import as_type

Version = Literal[2, 3]
#: What a soft sensor reads: pressures of both chambers, the pump's angle and the piston's position.
Sensor = Literal["volume"]
#: rms error [Pa] of a pressure by which a unit's step is chosen, and the commands under which.
ERROR = 1.0
COMMANDS = ("3 sin(4t)", "5 sin(2t)")
_COMPILE_TIMEOUT = 300.0
_README = """\
The machine's laws are LLVM code (.ll), the interface around them is C11. To build the library for another
system, with clang or `zig cc`: clang -O2 -fPIC -shared -I. -Iheaders -o NAME.so *.c *.ll -lm
"""


class Platform(NamedTuple):
    """A system that a unit runs on: its names in LLVM and the compiler, its folders in the archive, its suffix."""

    triple: str
    target: str
    folders: Mapping[int, str]
    suffix: str


PLATFORMS: Mapping[str, Platform] = as_type(
    dict[str, Platform], tomllib.loads((files("sealscope.fmu") / "platforms.toml").read_text("utf-8"))
)


def this_platform() -> str:
    """Return the name in `PLATFORMS` of this system.

    Raises InputError on another one.
    """
    import platform

    arm = platform.machine().lower() in ("arm64", "aarch64")
    name = {"linux": "linux", "win32": "windows", "darwin": "macos"}.get(sys.platform, sys.platform)
    name += "-arm" if arm else ""
    if name not in PLATFORMS:
        raise InputError(f"platform must be one of {', '.join(PLATFORMS)}, got {name}; name it")
    return name


def compiler() -> tuple[list[str], bool]:
    """Find a C compiler and whether it compiles for other systems: zig's, else the system's.

    Raises InputError where there is none.
    """
    from importlib.util import find_spec

    if find_spec("ziglang") is not None:
        return [sys.executable, "-P", "-m", "ziglang", "cc"], True
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path], False
    raise InputError("an FMU needs a C compiler, and there is none here; pip install 'sealscope[fmu]' brings it")


def fmi_headers() -> Path:
    """Find the folder of the standard's headers, which FMPy carries; raise InputError where it is not installed."""
    from importlib.util import find_spec

    package = find_spec("fmpy")
    if package is None or package.origin is None:
        raise InputError("an FMU needs the headers of FMI, which FMPy carries: pip install 'sealscope[fmu]'")
    return Path(package.origin).parent / "c-code"


def chosen_step(rig: Rig, error: float) -> tuple[float, float]:
    """Choose a step [s] of the solver by which pressures are off by `error` [Pa rms] at most, and its error.

    As a run of some seconds under each of `COMMANDS` chooses it, at the piston's mid-stroke.
    """
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.integrate import trajectory

    runs = [trajectory(Experiment.of(rig=rig, command=command, duration=4.0, error=error), ()) for command in COMMANDS]
    return min(run.step for run in runs), max(run.error for run in runs)


class MockUp(NamedTuple):
    """A unit before it is built: its code, its variables, and the sizes and starts that its layer in C needs.

    `modules`: LLVM code of its functions; `values`: parameters at the start, in the order of the code; `inputs`,
    `results`, `states`: how many; `step` [s]: longest step of its solver; `failures`: words for the codes that its
    functions return.
    """

    words: str
    modules: Mapping[str, str]
    listed: tuple[Variable, ...]
    values: tuple[float, ...]
    inputs: int
    results: int
    states: int
    step: float
    failures: Mapping[int, str]

    @property
    def token(self) -> str:
        """The unit's identity in the description and the library."""
        return hashlib.sha256("".join([self.words, str(self.listed), *self.modules.values()]).encode()).hexdigest()[:32]

    def write(self, path: Path, version: Version, platforms: Sequence[str]) -> None:
        """Write the unit's archive; raise InputError where the compiler refuses."""
        name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
        identifier = name if re.match(r"[A-Za-z_]", name) else f"_{name}"  # of C
        with tempfile.TemporaryDirectory(prefix="sealscope-fmu-") as folder, atomic_write(path) as temporary:
            place = Path(folder)
            sources = self._sources(place, version)
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                xml = description(version, identifier, self.token, self.words, self.listed)
                archive.writestr("modelDescription.xml", xml)
                for system in platforms:
                    target = f"binaries/{PLATFORMS[system].folders[version]}/{identifier}{PLATFORMS[system].suffix}"
                    archive.writestr(target, self._library(place, system, version))
                for source in sources:
                    archive.write(source, f"sources/{source.relative_to(place).as_posix()}")

    def _sources(self, place: Path, version: Version) -> list[Path]:
        """Write the sources of the unit below `place`, and return their paths."""
        layer = files("sealscope.fmu") / "c"
        present = {variable.reference - REFERENCES["value"] for variable in self.listed}
        config = (
            templates()
            .get_template("config.h.j2")
            .render(unit=self, references=REFERENCES, present=[int(k in present) for k in range(len(self.values))])
        )
        texts = {name: (layer / name).read_text("utf-8") for name in ("unit.c", "unit.h", f"fmi{version}.c")}
        texts |= {f"headers/{path.name}": path.read_text("utf-8") for path in fmi_headers().glob(f"fmi{version}*.h")}
        texts |= {"config.h": config} | {f"{function}.ll": module for function, module in self.modules.items()}
        texts["README.txt"] = _README
        (place / "headers").mkdir()
        for name, text in texts.items():
            (place / name).write_text(text, encoding="utf-8")
        return [place / name for name in texts]

    def _library(self, folder: Path, system: str, version: Version) -> bytes:
        """Build the shared library of the unit for a platform, from the sources in `folder`."""
        platform, (call, crosses) = PLATFORMS[system], compiler()
        inputs = [folder / "unit.c", folder / f"fmi{version}.c"]
        for function, module in self.modules.items():
            inputs.append(folder / f"{function}-{system}.o")
            inputs[-1].write_bytes(object_code(module, platform.triple))
        output = folder / f"{system}{platform.suffix}"
        target = ["-target", platform.target] if crosses else []
        flags = ["-std=c11", "-O2", "-fPIC", "-shared", f"-I{folder}", f"-I{folder / 'headers'}", "-o", str(output)]
        command = [*call, *target, *flags, *map(str, inputs), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_COMPILE_TIMEOUT, check=False)
        if done.returncode:
            caller, messages = " ".join(call), done.stderr[-500:]
            raise InputError(f"the C compiler ({caller}) could not build the unit for {system}: {messages}")
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
    """Write a rig as a functional mock-up unit for co-simulation.

    Its code is that of the laws which `simulate` runs, compiled; there is no Python in it. Inputs are the command, a
    leak, leakage outwards and a load; every parameter that the rig's laws take can be tuned; outputs are the states,
    the flows and the powers.

    Parameters
    ----------
    path : str or path-like
        File to write (.fmu).
    rig : Rig, str or path-like, optional
        A rig, the name of a packaged one, or the path of a TOML file.
    fmi : {2, 3}, optional
        Version of the Functional Mock-up Interface.
    platforms : sequence of str, optional
        Systems that it shall run on: "linux", "windows", "macos", and for FMI 3 also "macos-arm" and "linux-arm"; by
        default the one that runs. Others need the compiler that ``pip install 'sealscope[fmu]'`` brings.
    error : float, optional
        rms error [Pa] that a pressure may have, by which the longest step of the unit's solver is chosen.
    step : float, optional
        That step [s], instead of one chosen by `error`.

    Returns
    -------
    tuple of Variable
        What the unit lists: name, unit, causality, value at the start.

    Raises
    ------
    InputError
        An argument breaks a rule, or there is no compiler.

    Examples
    --------
    >>> import sealscope as ss
    >>> variables = ss.write_fmu("eha.fmu", step=5e-4)  # doctest: +SKIP
    >>> [variable.name for variable in variables if variable.causality == "input"]  # doctest: +SKIP
    ['u', 'G', 'C', 'F', 'G_ext_A', 'G_ext_B']
    """
    path, chosen_platforms = Path(path), _checked(path, fmi, platforms)
    machine = _pump_controlled(rig)
    if step is None:
        step, error_found = chosen_step(machine, error)
        accuracy = f"steps of at most {step:.3g} s, by which pressures are off by {error_found:.2g} Pa rms"
    elif step > 0:
        accuracy = f"steps of at most {step:.3g} s"
    else:
        raise InputError(f"step must be > 0 s, got {step}")
    unit = MockUp(
        f"{machine.title}; {accuracy}",
        code(Choice.from_rig(machine)),
        tuple(variables(machine, step)),
        values_of(machine),
        len(INPUTS),
        len(RESULTS),
        len(STATES),
        step,
        FAILURES,
    )
    unit.write(path, fmi, chosen_platforms)
    return unit.listed


@checked_call
def write_sensor_fmu(
    path: str | os.PathLike[str],
    *,
    sensor: Sensor = "volume",
    rig: Rig | str | os.PathLike[str] = "thesis",
    rate: float = 500.0,
    fmi: Version = 2,
    platforms: Sequence[str] | None = None,
) -> tuple[Variable, ...]:
    """Write a soft sensor of leakage as a functional mock-up unit for co-simulation.

    Readings go in, the leakage in m^3/s with its 95 % interval comes out, and its rise over the first minute. Its code
    is that of the live volume balance, compiled; there is no Python in it.

    Parameters
    ----------
    path : str or path-like
        File to write (.fmu).
    sensor : {"volume"}, optional
        What it reads beside the chamber pressures: the pump's angle and the piston's position.
    rig : Rig, str or path-like, optional
        The assumed machine: a rig, the name of a packaged one, or the path of a TOML file.
    rate : float, optional
        Sampling rate [Hz], 16 at least, whatever the communication steps are.
    fmi : {2, 3}, optional
        Version of the Functional Mock-up Interface.
    platforms : sequence of str, optional
        Systems that it shall run on, as of `write_fmu`.

    Returns
    -------
    tuple of Variable
        What the unit lists: name, unit, causality, value at the start.

    Raises
    ------
    InputError
        An argument breaks a rule, or there is no compiler.

    Examples
    --------
    >>> import sealscope as ss
    >>> variables = ss.write_sensor_fmu("leak.fmu", sensor="volume")  # doctest: +SKIP
    >>> [variable.name for variable in variables if variable.causality == "input"]  # doctest: +SKIP
    ['p_A', 'p_B', 'theta', 'x']
    """
    from sealscope.fmu import sensor as own

    path, chosen_platforms = Path(path), _checked(path, fmi, platforms)
    if sensor != "volume":
        raise InputError(f"sensor must be volume, got {sensor!r}")
    if not rate >= RESOLVED / STRIDE:
        raise InputError(f"rate of a soft sensor must be >= {RESOLVED / STRIDE:g} Hz, got {rate:g}")
    machine = _pump_controlled(rig)
    choice = own.SensorChoice.from_rig(machine, float(rate))
    unit = MockUp(
        f"soft sensor of leakage (volume balance of angle and position at {rate:g} Hz) for {machine.title}",
        own.sensor_code(choice),
        tuple(own.variables(machine)),
        values_of(machine),
        len(own.INPUTS),
        len(SENSOR_RESULTS),
        own.memory_of(choice).itemsize // 8,
        1.0 / rate,
        own.FAILURES,
    )
    unit.write(path, fmi, chosen_platforms)
    return unit.listed


def _pump_controlled(rig: Rig | str | os.PathLike[str]) -> Rig:
    """Load the rig of a unit; raise InputError for one with a servo valve."""
    machine = load_rig(rig)
    if machine.valve.spool == "present":
        raise InputError(f"a unit must be of a pump-controlled rig (valve.spool = absent), got {machine.name}")
    return machine


def _checked(path: str | os.PathLike[str], fmi: int, platforms: Sequence[str] | None) -> tuple[str, ...]:
    """Check name, version and platforms of a unit; return the platforms."""
    if Path(path).suffix != ".fmu":
        raise InputError(f"a unit's file must end in .fmu, got {path}")
    if fmi not in (2, 3):
        raise InputError(f"fmi must be 2 or 3, got {fmi!r}")
    chosen_platforms = tuple(dict.fromkeys(platforms or (this_platform(),)))
    for name in chosen_platforms:
        if name not in PLATFORMS or fmi not in PLATFORMS[name].folders:
            platform_names = ", ".join(key for key, platform in PLATFORMS.items() if fmi in platform.folders)
            raise InputError(f"a platform of FMI {fmi} must be one of {platform_names}, got {name!r}")
        if name != this_platform() and not compiler()[1]:
            raise InputError(f"a unit for {name} needs a compiler for it: pip install 'sealscope[fmu]'")
    return chosen_platforms
