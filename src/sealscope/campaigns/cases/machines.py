"""Build the experiment of a case: a machine drawn from a profile, its command, load, and a leak of known mean flow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sealscope.campaigns.cases.case import CampaignCase
from sealscope.campaigns.plans.duty import (
    CLOSED,
    COMMAND,
    CONTROLLER,
    FAMILY,
    LOAD,
    parse_plan_fault,
    parse_throttle_values,
)
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.parameters.rig import resolve_name
from sealscope.simulation.bench.machines import BenchMachine, draw
from sealscope.simulation.commands import DEFAULT_COMMAND
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import run_with_sized_leaks
from sealscope.simulation.leaks import Leak, opening_from
from sealscope.simulation.targets_and_loads import command_or_target, parse_force
from sealscope.units import LITRE_PER_MINUTE

#: Length [s] of the run in which a leak's coefficient is found: over two periods of the thesis's slowest command.
SIZING_SECONDS = 13.0


def case_leaks(plan: SimulatedPlan, case: CampaignCase) -> tuple[Leak, ...]:
    """Build the leaks of a case, which begin at the plan's onset, with mean flows but not yet coefficients.

    The law `mixture` gives two leaks with half of the flow each.
    """
    if not case.leak_lpm:
        return ()
    laws: tuple[Any, ...] = ("laminar", "orifice") if case.law == "mixture" else (case.law,)
    mean = case.leak_lpm * LITRE_PER_MINUTE / len(laws)
    return tuple(Leak(law, mean=mean, opening=opening_from(plan.onset_s)) for law in laws)


def experiment_with_flow_leak(plan: SimulatedPlan, case: CampaignCase) -> Experiment:
    """Build the experiment of a case, whose leaks have their mean flow but not yet a coefficient (`case_leaks`).

    The machine is drawn from the plan's profile with the seed of the case; without a profile it is the plan's rig. The
    levels (values) of the plan's factors replace the machine's parameters, command, controller and load.
    """
    if plan.machine_profile is not None:
        family = str(case.levels.get(FAMILY, ""))
        machine = draw(plan.machine_profile, case.machine_seed, rig=plan.rig, duration=plan.duration_s, family=family)
    else:
        machine = BenchMachine(
            profile="none",
            seed=case.machine_seed,
            rig=plan.rig,
            duration=plan.duration_s,
            overrides={},
            drifts=(),
            command=DEFAULT_COMMAND,
            closed=0.0,
        )
    values = dict(machine.overrides)
    for name, level in case.levels.items():
        if name == COMMAND:
            machine = replace(machine, command=command_or_target(str(level)))
        elif name == CONTROLLER:
            machine = replace(machine, controller=str(level))
        elif name == LOAD:
            machine = replace(machine, load=parse_force(str(level)))
        elif name == CLOSED:
            # closed throttles: `line.orifices` of the drawn machine must not remain, so it is set for a level of 0, too
            values |= {"line.orifices": str(plan.rig["line.orifices"])} | parse_throttle_values(level)
        elif name != FAMILY:
            values[name] = level
    # full names; if two entries are for the same parameter, the later one counts
    overrides = {resolve_name(name): value for name, value in values.items()}
    machine = replace(machine, overrides=overrides)
    fault = parse_plan_fault(case.fault, plan.onset_s) if case.fault else None
    return machine.experiment(seed=case.noise_seed, fault=fault, leak=case_leaks(plan, case))


def case_experiment(plan: SimulatedPlan, case: CampaignCase) -> Experiment:
    """Build the experiment of a case, with the leak coefficients that give the planned mean flow."""
    experiment = experiment_with_flow_leak(plan, case)
    return replace(experiment, leaks=size_leaks_on_short_run(experiment))


def size_leaks_on_short_run(experiment: Experiment) -> tuple[Leak, ...]:
    """Find the coefficients of an experiment's leaks that give their planned mean flows; return the completed leaks.

    The search uses a run of at most `SIZING_SECONDS` with the leaks open from the start, so the true mean flow of the
    record may differ a little.
    """
    if not experiment.leaks:
        return ()
    open_leaks = tuple(replace(leak, opening=opening_from(0.0)) for leak in experiment.leaks)
    sized, _ = run_with_sized_leaks(
        replace(experiment, duration=min(experiment.duration, SIZING_SECONDS), leaks=open_leaks)
    )
    return tuple(replace(leak, opening=planned.opening) for leak, planned in zip(sized, experiment.leaks, strict=True))
