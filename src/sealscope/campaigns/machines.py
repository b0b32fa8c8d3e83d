"""From a case to the machine it is run on: the bench's draw, the case's duty on it, the leak sized for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sealscope.campaigns.cases import Case, digest
from sealscope.campaigns.plan import Plan
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.simulation.bench.profile import Profile
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.faults.faults import Fault, Leak

#: Length [s] of the run that sizes a leak on its machine; two periods of the slowest of the thesis's commands.
SIZING_SECONDS = 13.0


def closing_values(level: str | float) -> dict[str, str | float]:
    """The rig's parameters for both throttles closed by that share; fully open ones leave `line.orifices` as it is."""
    from sealscope.units import parse_quantity

    share = parse_quantity(level, "1") if isinstance(level, str) else float(level)
    if not 0.0 <= share < 1.0:
        raise InputError(f"closed must be 0 to under 100 %, got {level!r}")
    values: dict[str, str | float] = {"line.closed_A": share, "line.closed_B": share}
    return {**values, "line.orifices": "present"} if share > 0 else values


def profile_key(name: str) -> str:
    """A name for what a bench profile says, the same wherever its file lies."""
    from sealscope.simulation.bench.profile import load_profile

    return digest(repr(replace(load_profile(name), place="")))


def fault_of(words: str, onset_s: float) -> Fault:
    """A fault other than a piston leak, from words; it sets in at the plan's onset unless they say when."""
    from sealscope.simulation.faults.parse import parse_fault

    timed = any(f" {word} " in f" {words} " for word in ("from", "growing"))
    fault = parse_fault(words if timed else f"{words} from {onset_s:g} s")
    if fault is None:
        raise InputError(f"a fault must be one, got {words!r}")
    return fault


def leak_of(plan: Plan, case: Case) -> tuple[Leak, ...]:
    """The case's leak, open from the plan's onset on; its size still a mean flow."""
    from sealscope.simulation.faults.faults import From, Leak
    from sealscope.units import LITRE_PER_MINUTE

    if not case.leak_lpm:
        return ()
    law: Any = case.law
    return (Leak(law, mean=case.leak_lpm * LITRE_PER_MINUTE, opening=From(plan.onset_s)),)


def unsized(plan: Plan, case: Case, profile: Profile | None = None) -> Experiment:
    """The experiment of a case: the machine that its seed draws from the bench (or the rig as it stands), the case's
    levels on top; the size of its leak still a mean flow. `profile`: the plan's bench, where it has been loaded."""
    from sealscope.simulation.bench.machines import Machine, draw
    from sealscope.simulation.commands import Sine, parse_command

    if plan.profile:
        machine = draw(profile or plan.profile, case.machine_seed, rig=plan.rig, duration=plan.duration_s)
    else:
        machine = Machine("none", case.machine_seed, plan.rig, plan.duration_s, {}, (), Sine(3.0, 4.0), 0.0)
    settings = dict(machine.values)
    for name, level in case.levels.items():
        if name == "command":
            machine = replace(machine, command=parse_command(str(level)))
        elif name == "closed":
            settings |= {"line.orifices": str(plan.rig["line.orifices"])} | closing_values(level)
        else:
            settings[name] = level
    machine = replace(machine, values=_once(settings))
    fault = fault_of(case.fault, plan.onset_s) if case.fault else None
    return machine.experiment(seed=case.noise_seed, fault=fault, leak=leak_of(plan, case))


def experiment_of(plan: Plan, case: Case) -> Experiment:
    """The experiment of a case (`unsized`) with its leak sized on its machine."""
    experiment = unsized(plan, case)
    return replace(experiment, leaks=sized_once(experiment))


def _once(settings: Mapping[str, str | float]) -> dict[str, str | float]:
    """Settings by their full names, a later one in place of an earlier."""
    from sealscope.parameters import declared_names
    from sealscope.parameters.names import resolve

    return {resolve(name, declared_names()): value for name, value in settings.items()}


def sizing_run(experiment: Experiment) -> Experiment:
    """The short run on which an experiment's leaks are sized, open from its start."""
    from sealscope.simulation.faults.faults import From

    return replace(
        experiment,
        duration=min(experiment.duration, SIZING_SECONDS),
        leaks=tuple(replace(leak, opening=From(0.0)) for leak in experiment.leaks),
    )


def sized_once(experiment: Experiment) -> tuple[Leak, ...]:
    """The experiment's leaks with coefficients that give their means on this machine over a short run of its own.

    Sizing on the whole record would cost it two or three times over; the mean that the record really had is told in
    its row.
    """
    from sealscope.simulation.simulate import sized_leaks

    if not experiment.leaks:
        return ()
    found = sized_leaks(sizing_run(experiment))
    return tuple(replace(one, opening=leak.opening) for one, leak in zip(found, experiment.leaks, strict=True))
