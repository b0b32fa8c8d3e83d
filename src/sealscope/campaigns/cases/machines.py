"""From a case to its machine: the bench's draw, the case's duty, the leak sized for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sealscope.campaigns.cases.case import FAMILY, CampaignCase
from sealscope.campaigns.plans.duty import COMMAND, CONTROLLER, LOAD, closing_values, fault_of
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.parameters import declared_names
from sealscope.parameters.names import resolve
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.bench.profile import Profile
from sealscope.simulation.commands import Sine
from sealscope.simulation.courses import command_or_target, parse_force
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import sized_leaks
from sealscope.simulation.leaks import Leak, from_time
from sealscope.units import LITRE_PER_MINUTE

#: Length [s] of the run that sizes a leak on its machine; two periods of the slowest of the thesis's commands.
SIZING_SECONDS = 13.0


def leak_of(plan: SimulatedPlan, case: CampaignCase) -> tuple[Leak, ...]:
    """Build the case's leak, open from the plan's onset on, its size still a mean flow."""
    if not case.leak_lpm:
        return ()
    laws: tuple[Any, ...] = ("laminar", "orifice") if case.law == "mixture" else (case.law,)
    mean = case.leak_lpm * LITRE_PER_MINUTE / len(laws)
    return tuple(Leak(law, mean=mean, opening=from_time(plan.onset_s)) for law in laws)


def unsized(plan: SimulatedPlan, case: CampaignCase, profile: Profile | None = None) -> Experiment:
    """Build the experiment of a case, the size of its leak still a mean flow.

    The machine is the one that the case's seed draws from the bench (or the plan's rig), with the case's levels on
    top. `profile`: the plan's bench, where it has been loaded.
    """
    if plan.profile:
        family = str(case.levels.get(FAMILY, ""))
        machine = draw(
            profile or plan.profile, case.machine_seed, rig=plan.rig, duration=plan.duration_s, family=family
        )
    else:
        machine = BenchMachine("none", case.machine_seed, plan.rig, plan.duration_s, {}, (), Sine(3.0, 4.0), 0.0)
    values = dict(machine.overrides)
    for name, level in case.levels.items():
        if name == COMMAND:
            machine = replace(machine, command=command_or_target(str(level)))
        elif name == CONTROLLER:
            machine = replace(machine, controller=str(level))
        elif name == LOAD:
            machine = replace(machine, load=parse_force(str(level)))
        elif name == "closed":
            values |= {"line.orifices": str(plan.rig["line.orifices"])} | closing_values(level)
        elif name != FAMILY:
            values[name] = level
    machine = replace(machine, overrides=_by_full_name(values))
    fault = fault_of(case.fault, plan.onset_s) if case.fault else None
    return machine.experiment(seed=case.noise_seed, fault=fault, leak=leak_of(plan, case))


def experiment_of(plan: SimulatedPlan, case: CampaignCase) -> Experiment:
    """Build the experiment of a case (`unsized`) with its leak sized on its machine."""
    experiment = unsized(plan, case)
    return replace(experiment, leaks=sized_once(experiment))


def _by_full_name(values: Mapping[str, str | float]) -> dict[str, str | float]:
    """Key the values by their full names; the later of two with the same name counts."""
    return {resolve(name, declared_names()): value for name, value in values.items()}


def sizing_run(experiment: Experiment) -> Experiment:
    """Build the short run on which an experiment's leaks are sized, open from its start."""
    return replace(
        experiment,
        duration=min(experiment.duration, SIZING_SECONDS),
        leaks=tuple(replace(leak, opening=from_time(0.0)) for leak in experiment.leaks),
    )


def sized_once(experiment: Experiment) -> tuple[Leak, ...]:
    """Find the coefficients of an experiment's leaks that give their means over a short run.

    Sizing on the whole record would cost it two or three times over; the mean that the record really had is in its
    row.
    """
    if not experiment.leaks:
        return ()
    sized = sized_leaks(sizing_run(experiment))
    return tuple(replace(leak, opening=planned.opening) for leak, planned in zip(sized, experiment.leaks, strict=True))
