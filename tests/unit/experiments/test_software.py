"""The software of robots: what it needs, which programs it has, and which experiments are done with it."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments import workloads
from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.runner import Plan
from rce_fleet.experiments.systems import roscpp_programs
from rce_fleet.experiments.systems.software import RCE, ROS, ROSCPP, software_of

ALL = ("ros", "roscpp", "rce")


def programs_in_cpp() -> set[str]:
    text = (roscpp_programs.sources() / "main.cpp").read_text()
    return set(re.findall(r'\{"(\w+)", \w+\}', text))


def test_each_program_in_cpp_has_one_in_python() -> None:
    assert workloads.__file__ is not None
    modules = {path.stem for path in Path(workloads.__file__).parent.glob("*.py")}
    assert programs_in_cpp() == roscpp_programs.PROGRAMS
    assert modules >= roscpp_programs.PROGRAMS


def test_the_programs_of_experiments_are_modules() -> None:
    assert workloads.__file__ is not None
    for experiment in EXPERIMENTS.values():
        for program in experiment.programs:
            assert Path(workloads.__file__).with_name(f"{program}.py").exists()


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One tool after the other is put into an empty folder of programs."""
    monkeypatch.setenv("PATH", str(tmp_path))

    def put(name: str, script: str) -> None:
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o700)

    assert software_of("rce") is RCE
    with pytest.raises(ExperimentError, match=r"the software ros .* needs the program roscore \(Debian: "):
        software_of("ros")
    put("roscore", "")
    assert software_of("ros") is ROS
    with pytest.raises(ExperimentError, match=r"the software roscpp .* needs the program g\+\+ \(Debian: "):
        software_of("roscpp")
    put("g++", "")
    assert ROSCPP.missing() == "the program pkg-config (Debian: pkg-config)"
    put("pkg-config", '[ "$2" != sensor_msgs ]')
    assert ROSCPP.missing() == "the headers of sensor_msgs (Debian: libsensor-msgs-dev)"
    put("pkg-config", "")
    assert software_of("roscpp") is ROSCPP


def test_what_a_compiler_says_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, script in (("pkg-config", "echo"), ("g++", "echo $7: ros.h is missing >&2; exit 1")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o700)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    source = tmp_path / "main.cpp"
    with pytest.raises(ExperimentError, match=r"main.cpp cannot be compiled:\n .*ros.h is missing"):
        roscpp_programs.compile_program(source, tmp_path / "program")
    assert not (tmp_path / "program").exists()


def test_a_program_without_a_form_in_cpp_is_refused() -> None:
    with pytest.raises(ExperimentError, match="the program reach has no form in C"):
        ROSCPP.workload("reach")
    assert ROS.lacking(["reach"]) == RCE.lacking(["reach"]) == []


def test_experiments_are_done_with_software_that_has_their_programs() -> None:
    plan = Plan(list(EXPERIMENTS.values()), Options(software=ALL), 1, 1)
    assert plan.left_out() == [
        "robustness is not done with the software roscpp: it has no program provider, watcher",
        "isolation is not done with the software roscpp: it has no program reach, robot_base",
    ]
    used = {
        name: {setup.software for setup in one.setups(plan.options_of(one))}
        for name, one in EXPERIMENTS.items()
    }
    assert used["laser"] == used["round-trip"] == set(ALL)
    assert used["isolation"] == {"ros", "rce"}


def test_the_first_software_of_an_experiment_is_one_that_it_can_have() -> None:
    plan = Plan(list(EXPERIMENTS.values()), Options(software=("roscpp", "rce")), 1, 1)
    for name, software in (("scaling", "roscpp"), ("robustness", "rce")):
        works = plan.works(EXPERIMENTS[name], [])
        assert {work.run.condition.software for work in works} == {software}


def test_an_experiment_without_software_is_an_error() -> None:
    options = Options(software=("roscpp",))
    with pytest.raises(ExperimentError, match="isolation is not done with the software roscpp: it has no"):
        Plan([EXPERIMENTS["isolation"]], options, 1, 1).left_out()
    both = Plan([EXPERIMENTS["isolation"], EXPERIMENTS["laser"]], options, 1, 1)
    assert len(both.left_out()) == 1
    assert both.works(EXPERIMENTS["isolation"], []) == []


def test_roscpp_is_measured_only_if_it_is_named() -> None:
    assert Options().software == ("ros", "rce")
