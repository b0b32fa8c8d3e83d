"""Healthy recordings of a machine, and its file, shared by the tests of a commissioned machine."""

from __future__ import annotations

import pytest

import sealscope as ss


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Three healthy recordings of 20 s."""
    path = tmp_path_factory.mktemp("healthy")
    for seed in range(1, 4):
        ss.write(ss.simulate(command="3 sin(4t)", duration="20 s", seed=seed), path / f"run{seed}.nc")
    return path


@pytest.fixture(scope="session")
def healthy(folder):
    return [ss.read(path) for path in sorted(folder.iterdir())]


@pytest.fixture(scope="session")
def machine(folder):
    return ss.commission(folder, rig="thesis", name="actuator7")


@pytest.fixture(scope="session")
def file(machine, tmp_path_factory):
    return ss.write_machine(machine, tmp_path_factory.mktemp("machine") / "actuator7.toml")


@pytest.fixture(scope="session")
def by_pressures(folder, tmp_path_factory):
    """The file of the same machine, whose logger records pressures and command alone."""
    path = tmp_path_factory.mktemp("pressures")
    for file in folder.iterdir():
        ss.write(ss.read(file).only(("u", "p_A", "p_B")), path / file.name)
    return ss.write_machine(ss.commission(path, rig="thesis"), path / "machine.toml")
