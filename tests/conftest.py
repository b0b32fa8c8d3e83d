"""The rig of the checks, and a short way to run it."""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from sealscope.diagnosis.detectors import registry
from sealscope.parameters import Rig, load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import Trajectory, integrate_run
from sealscope.simulation.leaks import Leak

#: The rig of the independent results: 26.7 rad/s per volt, 0.25 MPa everywhere at the start, line volumes of 50 cm^3.
CHECK_RIG = {"omega_per_volt": 26.7, "p_charge": 0.25e6, "V_1": 50e-6, "V_2": 50e-6}
HALF_CLOSED = {"orifices": "present", "closed_A": "50 %", "closed_B": "50 %"}
#: Files and folders that come first and last, in this order. Two processes take file after file. Last
#: come a file that would compile what the other process compiles at that moment, and folders of short files, so that
#: neither process waits long.
FIRST = ("recordings", "reporting")
LAST = ("control/test_margins.py", "parameters", "evaluation", "signals", "storage")


_approx = pytest.approx


def approx(expected: Any, rel: float | None = None, abs: float | None = None, nan_ok: bool = False) -> Any:
    """Compare as `pytest.approx`, but without an absolute tolerance unless one is given.

    pytest's own, 1e-12, is larger than a leak in m^3/s: any number would pass for it.
    """
    if abs is None:
        rel, abs = 1e-6 if rel is None else rel, 0.0
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


pytest.approx = approx  # type: ignore[assignment]


# no deadline: the first example of a test may have to compile; tests/fuzz draws many more examples of what comes from
# outside; a CI run judges a commit by the same examples each time
settings.register_profile("sealscope", max_examples=20, deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("sealscope")


def pytest_configure() -> None:
    """One BLAS thread: the matrices are small, and two test processes with two threads each take ten times as long.

    And interrupts reach the processes that tests start, also where the tests run in the background of a shell that
    ignores them for its jobs: an ignored signal is inherited, a handled one is not.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    threadpool_limits(limits=1)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect the tests without collecting garbage: modules and tests stay, and are not gone through again later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000)  # of the arrays and texts that a test makes hardly any is in a circle
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the files by `FIRST` and `LAST`; the others, and the tests of a file, keep their order."""
    here = Path(__file__).parent

    def place(item: pytest.Item) -> int:
        path = item.path.relative_to(here).as_posix()
        names = {path, path.partition("/")[0]}
        places = {name: k - len(FIRST) for k, name in enumerate(FIRST)} | {name: k + 1 for k, name in enumerate(LAST)}
        return min((places[name] for name in names & places.keys()), default=0)

    items.sort(key=place)


@pytest.fixture
def two_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let diagnoses in this process run the volume balance and `rms change` alone: for what does not ask who judges."""
    kept = {name: registry.DETECTORS[name] for name in ("volume balance", "rms change")}
    monkeypatch.setattr(registry, "DETECTORS", kept)


@pytest.fixture
def rms_change_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let diagnoses in this process run the detector `rms change` and no other."""
    monkeypatch.setattr(registry, "DETECTORS", {"rms change": registry.DETECTORS["rms change"]})


@pytest.fixture(scope="session")
def check_rig() -> Callable[..., Rig]:
    """The check rig with values replaced; `throttled` puts both throttles in, half closed by area."""

    def make(throttled: bool = False, **values: Any) -> Rig:
        throttles = HALF_CLOSED if throttled else {}
        return load_rig("thesis").with_overrides({**CHECK_RIG, **throttles, **values})

    return make


@dataclass(frozen=True)
class Driven:
    """A command as a function of time."""

    volts: Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="session")
def drive() -> Callable[..., Trajectory]:
    """Integrate a rig under u = amplitude sin(4 t) (or a function of time) with constant leakage coefficients."""

    def run(
        rig: Rig,
        duration: float,
        *,
        u: Callable[[np.ndarray], np.ndarray] | float = 3.0,
        G: float = 0.0,
        C: float = 0.0,
        rate: float = 500.0,
        step: float | None = None,
        kind: type[Experiment] = Experiment,
        **options: Any,
    ) -> Trajectory:
        volts = u if callable(u) else lambda t: u * np.sin(4.0 * t)
        experiment = kind(rig, Driven(volts), duration, **options)
        leaks = (Leak("laminar", coefficient=G), Leak("orifice", coefficient=C))
        return integrate_run(experiment, leaks, step=step, duration=duration, rate=rate)

    return run


@pytest.fixture(autouse=True)
def nothing_learnt_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no test see what others learnt of the same recording, perhaps under other priors: results are not kept."""
    monkeypatch.setattr("sealscope.diagnosis.healthy.results_folder", lambda: None)


@pytest.fixture(autouse=True)
def unlimited_log() -> None:
    """Let this test's log have any number of lines: a monitor that another test ran limits those of all handlers."""
    for handler in logging.getLogger().handlers:
        handler.filters[:] = [kept for kept in handler.filters if type(kept).__name__ != "LimitedLines"]
