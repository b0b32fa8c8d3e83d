"""What is said of real cranes: a small one with a flow meter, and a loader crane whose loads are held by shut valves.

    python benchmarks/real_cranes.py FOLDER

FOLDER holds files of the public repository emilah-png/Bachelor, fetched by yourself: it has no licence, and none of it
is part of this project. Read are `FlowTest.mat` (its first 36 s: a hold of 23 s, then a stroke in) and, as far as they
are there, the loader crane's CSV named below. Two rows for the flow meter's crane: the stroke by the meter, and the
hold by how the piston gives way. "Passes": what the loaded side loses in all, with its 95 % interval; whether seal,
valve or line loses it, no channel tells. The meter's scale is its maker's to within 20 %, one for each direction.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import sealscope as ss
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording

LOADER = (
    "Dual1SineRun_230425",
    "MainSineTest_230425",
    "JibSineTest_230425",
    "Dual2SineTest_230425",
    "RampDisturbanceTestPID_230425",
    "Main2Test_090525",
    "Jib1Test_090525",
    "FixedXSensor_090525",
)
#: Columns of position, command and both chambers, and the areas of piston and ring [mm^2], of either cylinder.
CYLINDERS = {
    "Main": (("MainPistonPosition", "MainU", "MainPaCyl", "MainPbDCV"), (20106.0, 12252.0)),
    "Jib": (("JibPistonPosition", "JibU", "JibPaCyl", "JibPbCyl"), (17671.0, 9817.0)),
}
#: Streams of the flow meter's log, its zero and scale [bits, bits per L/min], and what is developed on [samples].
STREAMS, ZERO, SCALE, HOLD, DEVELOPED = {"p_A": 0, "p_B": 1, "x": 15, "u": 17, "bits": 9}, 15264.0, 90.0, 2300, 3600
BAR, LPM, RATE = 1e5, 1e-3 / 60.0, 100.0
UNITS = {"u": "V", "x": "m", "p_A": "Pa", "p_B": "Pa", "q_pump": "m^3/s"}


def crane(area_A: float, area_B: float, stroke: float) -> Rig:
    """Return a rig behind a valve with areas [mm^2] and a stroke [m]."""
    volume = f"{0.75e-3 * area_A * stroke} l"
    areas = {"cylinder.A_A": f"{area_A} mm^2", "cylinder.A_B": f"{area_B} mm^2"}
    return load_rig("servo-valve").with_overrides({**areas, "cylinder.L": f"{stroke} m", "cylinder.V": volume})


def recording(channels: dict[str, np.ndarray]) -> Recording:
    """Return a recording at 100 Hz."""
    count = min(map(len, channels.values()))
    samples = {name: values[:count] for name, values in channels.items()}
    return Recording(np.arange(count) / RATE, samples, {name: UNITS[name] for name in samples}, RATE)


def with_meter(path: Path) -> dict[str, Recording]:
    """Return stroke and hold of the crane with the flow meter."""
    import h5py

    with h5py.File(path) as file:
        raw = {
            name: np.ascontiguousarray(file[f"#sigstream#/{n}/#data#"][()]).ravel().view(np.float64)[:DEVELOPED]
            for name, n in STREAMS.items()
        }
    own = {"p_A": BAR * raw["p_A"], "p_B": BAR * raw["p_B"], "x": raw["x"]}
    flow = (ZERO - raw["bits"]) / SCALE * LPM
    hold = {name: values[:HOLD] for name, values in {**own, "u": raw["u"]}.items()}
    return {"flow meter, stroke": recording({**own, "q_pump": flow}), "flow meter, hold": recording(hold)}


def of_loader(path: Path, columns: tuple[str, ...]) -> Recording:
    """Return one cylinder of the loader crane; each column `Name` holds the time [ms] of those that follow it."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    first = next(k for k, line in enumerate(lines) if "MainPaCyl" in line)
    names = lines[first].split(",")
    rows = [line.split(",") for line in lines[first + 1 :]]
    table = np.array(
        [[float(cell.strip() or "nan") for cell in row[: len(names)]] for row in rows if len(row) >= len(names)]
    )
    time, series = table[:, 0], {}
    for name, values in zip(names, table.T, strict=True):
        time = values if name == "Name" else time
        known = np.isfinite(time) & np.isfinite(values)
        series[name] = (1e-3 * time[known], values[known])
    at = np.arange(0.0, min(series[name][0][-1] for name in columns), 1.0 / RATE)
    x, u, p_A, p_B = (np.interp(at, *series[name]) for name in columns)
    return recording({"u": u, "x": x, "p_A": BAR * p_A, "p_B": BAR * p_B})


def row(name: str, log: Recording, rig: Rig) -> str:
    """Return what is said of a recording as a row of the table."""
    verdict = ss.diagnose(log, rig=rig)
    balance = VolumeBalance(rig).balance(log)
    passes = "" if balance is None else np.array(balance.conductance) * balance.mean_pressure() / LPM * 1e3
    passed = "" if balance is None else f"{passes[0]:.1f} ({passes[1]:.1f} to {passes[2]:.1f})"
    bound = "" if verdict.bound_lpm is None else f"{1e3 * verdict.bound_lpm:.3g}"
    return f"| {name} | {verdict.verdict} | {verdict.cause or ''} | {bound} | {passed} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    print("| recording | verdict | cause | bound [mL/min] | passes [mL/min] |\n| --- | --- | --- | --- | --- |")
    if (folder / "FlowTest.mat").is_file():
        for name, log in with_meter(folder / "FlowTest.mat").items():
            print(row(name, log, crane(3318.3, 2356.2, 0.5)), flush=True)
    else:
        print(f"skipped: FlowTest.mat is not in {folder}")
    for name in LOADER:
        path = folder / f"{name}.csv"
        if not path.is_file():
            print(f"skipped: {path.name} is not in {folder}")
            continue
        for cylinder, (columns, areas) in CYLINDERS.items():
            print(row(f"{name}, {cylinder.lower()}", of_loader(path, columns), crane(*areas, 1.0)), flush=True)


if __name__ == "__main__":
    main()
