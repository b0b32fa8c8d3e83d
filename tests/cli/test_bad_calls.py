"""Calls that cannot be done: wrong words, impossible machines, places that cannot be written."""

from __future__ import annotations

import pytest

import sealscope

SIMULATE = ("simulate", "-o", "run.nc", "--duration", "5")
THROTTLED = ("--set", "orifices=present", "--set", "closed_A=50 %", "--set", "closed_B=50 %")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--set", "V_1=-3"), "V_1 must be greater than 0 m^3, got -3.0 (set by --set)"),
        (("--set", "L_c=0"), "L_c must be greater than 0 H, got 0.0 (set by --set)"),
        (("--set", "V_1=50[bar]"), "V_1 must have a unit of volume, such as m^3, got bar (set by --set)"),
        (("--set", "V_1=nan"), "V_1 must be a finite number, got nan (set by --set)"),
        (("--set", "wibble=3"), "'wibble' is not a parameter"),
        (("--set", "noise=3"), "parameter noise is not unique, give one of sensors."),
        (("--set", "V_1"), "an override must be NAME=VALUE or NAME=VALUE[unit], got 'V_1'"),
        (("--set", "V_1=5e-5", "--set", "V_1=6e-5"), "V_1 must be set once, got 5e-5 and 6e-5"),
        (("--set", "orifices=maybe"), "orifices must be one of "),
        (("--command", "11 sin(4t)"), "command must stay within +-10 V, got "),
        (("--command", "step 10.5 at 2 s"), "command must stay within +-10 V, got 10.5 V at t = 2 s ("),
        (("--command", "wobble"), "command must be like '3 sin(4t)'"),
        (("--leak", "50 L/min"), "a leak must be smaller than the pump's mean flow, 0.5854 L/min for this command"),
        (("--leak", "a lot"), "leak must be like '0.0042 L/min from 90 s'"),
        (("--leak", "0.01 bar/s"), "a leak must have a unit of volume flow"),
        (("--leak", "0.01 L/min from 9 s"), "a leak with a mean flow must be open within the run, got 0.01 L/min"),
        (("--leak", "-0.01 L/min"), "leak must be like '0.0042 L/min from 90 s'"),
        (("--leak", "0.01 L/min growing from 3 s to 2 s"), "a growing leak must stop growing after it starts"),
        (("--rig", "nowhere"), "'nowhere' is no packaged rig (servo-valve, single-rod-eha, thesis,"),
        (("--rig", "absent.toml"), "a rig file must be readable, got: No such file or directory (absent.toml)"),
        (("--rig", "unsourced.toml"), "q_b must have a source, got none (unsourced.toml)"),
        (("--rig", "broken.toml"), "a rig file must be TOML: "),
        (("--duration", "0"), "duration must be > 0 s and finite, got 0.0"),
        (("--duration", "soon"), "duration must be a number with or without a unit, such as 2[s], got 'soon'"),
        (("--duration", "5[m]"), "duration must have a unit of time, such as s, got m"),
        (("--duration", "1e12"), "duration x daq.sample_rate must be 1 to 20000000 samples"),
        (("--step", "-1"), "step must be > 0 s, got -1.0"),
        (("--step", "1[V]"), "step must have a unit of time, such as s, got V"),
        (("--seed", "-1"), "seed must be >= 0, got -1"),
        (("--method", "euler"), "method must be auto, rk4 or imex, got 'euler'"),
        (("--method", "imex"), "method imex needs throttles"),
        (("--start-position", "2"), "x_0 must be within the stroke, -0.3 m to 0.3 m, got 2.0"),
        (("-o", "nowhere/run.nc"), "the folder of a file to write must exist, got nowhere (nowhere/run.nc)"),
        (("-o", "run.xls"), "a recording's file must end in .nc"),
        (("--truth", "nowhere/truth.json"), "the folder of a file to write must exist, got nowhere ("),
        (("--truth", "run.nc"), "recording and truth must be two files, got run.nc for both"),
    ],
)  # fmt: skip
def test_a_simulation_that_cannot_be(words, complaint, call, untouched, tmp_path):
    (tmp_path / "unsourced.toml").write_text(
        '[rig]\nextends = "thesis"\n[pump]\nq_b = { value = 5, unit = "cm^3/rev" }\n'
    )
    (tmp_path / "broken.toml").write_text("[rig\n")
    untouched()
    done = call(*SIMULATE, *words)
    assert done.refused(2).startswith(complaint)
    assert done.out == ""


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((*THROTTLED, "--prove", "--method", "rk4", "--step", "1e-4"), "for rk4 with throttles"),
        ((*THROTTLED, "--method", "rk4", "--step", "1e-4"), "for rk4 with throttles"),
        (("--prove", "--step", "0.01"), "to resolve speed loop, oil columns and friction of this rig"),
        (("--prove", "--step", "0.0015"), "the run is under-resolved: halving the step of 0.001 s (rk4) moves "),
        (("--set", "k_p=50000", "--set", "K_i=100"), "to resolve speed loop"),
        (("--command", "ramp 8 to 0.5 s", "--start-position", "0.28"), "must stay above vacuum"),
    ],
)  # fmt: skip
def test_a_run_that_cannot_be_trusted_fails_and_leaves_nothing(words, complaint, call, untouched):
    done = call(*SIMULATE, *words)
    assert complaint in done.refused(1)
    assert done.out == ""


def test_an_unresolved_run_comes_through_only_when_asked_for_and_is_marked(call, tmp_path):
    done = call(
        "simulate", "-o", tmp_path / "run.nc", "--duration", 5, "--step", 0.0015, "--prove", "--allow-unresolved"
    )
    assert done.status == 0
    assert "NOT RESOLVED" in done.out
    assert sealscope.read(tmp_path / "run.nc").provenance["solver"]["allow_unresolved"] is True


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("diagnose", "log.csv", "--false-alarm", "3"), "false-alarm probability must be 0.0001 to 0.2, got 3.0"),
        (("diagnose", "log.csv", "--false-alarm", "nan"), "false-alarm probability must be 0.0001 to 0.2, got nan"),
        (("diagnose", "log.csv", "--rate", "0"), "rate must be > 0 Hz, got 0.0"),
        (("diagnose", "log.csv", "--map", "p_A"), "a map must read CHANNEL=COLUMN"),
        (("diagnose", "log.csv", "--map", "P=a"), "a mapped channel must be one of u, "),
        (("diagnose", "log.csv", "--map", "p_A=a", "--map", "p_A=b"), "--map p_A must be given once, got a and b"),
        (("diagnose", "log.csv", "--baseline"), "--baseline must be followed by one file or more, got none"),
        (("diagnose", "--baseline", "--rate", "5", "log.csv"), "--baseline must be followed by one file or more"),
        (("report", "log.csv", "-o", "nowhere/page.html"), "the folder of a file to write must exist, got nowhere"),
        (("report", "log.csv", "-o", "log.csv"), "a page must not replace a recording, got log.csv"),
        (("report", "log.csv", "-o", "page.svg"), "a page must be a file .html, .htm, .pdf, .png, got page.svg"),
        (("report", "log.csv", "other.csv", "-o", "log.csv"), "cannot create folder: File exists (log.csv)"),
        (("report", "log.csv", "./log.csv", "-o", "pages"), "pages must have names of their own, got pages/log.html"),
        (("convert", "log.csv", "log.xls"), "a recording's file must end in .nc"),
        (("convert", "log.csv", "nowhere/log.nc"), "the folder of a file to write must exist, got nowhere"),
        (("fmu", "-o", "leak.fmu", "--sensor", "volume", "--step", "1 ms"), "--step is of a rig's solver, got it with"),
        (("fmu", "-o", "leak.fmu", "--sensor", "volume", "--error", "1[Pa]"), "--error is of a rig's solver, got it"),
        (("fmu", "-o", "eha.fmu", "--rate", "100 Hz"), "--rate is of a soft sensor, got it without --sensor"),
        (
            ("fmu", "-o", "leak.fmu", "--sensor", "volume", "--rate", "10 Hz"),
            "rate of a soft sensor must be >= 16 Hz",
        ),
        (
            ("parameters", "nowhere"),
            "'nowhere' is no packaged rig (servo-valve, single-rod-eha, thesis,",
        ),
        (("parameters", "--set", "V_1=0"), "V_1 must be greater than 0 m^3, got 0.0 (set by --set)"),
    ],
)
def test_a_call_that_breaks_a_rule(words, complaint, call, untouched, tmp_path):
    for name in ("log.csv", "other.csv"):
        (tmp_path / name).write_text("t [s],p_A [Pa]\n" + "".join(f"{k / 500},{k % 7}\n" for k in range(50)))
    untouched()
    done = call(*words)
    assert done.refused(2).startswith(complaint)
    assert done.out == ""


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("nothing",), "nothing"),
        (("diagnose",), "FILE"),
        (("diagnose", "log.csv", "--wibble"), "--wibble"),
        (("diagnose", "log.csv", "--format", "xml"), "xml"),
        (("diagnose", "log.csv", "--rate", "fast"), "--rate"),
        (("simulate",), "--output"),
        (("simulate", "-o", "run.nc", "--seed", "one"), "--seed"),
        (("convert", "log.csv"), "target"),
        (("report", "log.csv"), "--output"),
    ],
)
def test_wrong_words_are_answered_with_the_usage(words, complaint, call, untouched):
    assert complaint.lower() in call(*words).misused().lower()


def test_a_process_of_its_own_answers_wrong_words_alike(call, shell, untouched):
    words = ("diagnose", "log.csv", "--wibble")
    assert shell("sealscope", *words).misused() == call(*words).misused()


def test_no_words_at_all_show_the_commands(call):
    done = call()
    assert done.status in (0, 2)  # by the version of the library that reads the words
    for command in ("demo", "simulate", "diagnose", "parameters", "convert", "report"):
        assert command in done.out + done.err


@pytest.mark.parametrize(
    "words", [SIMULATE, ("convert", "log.csv", "copy.nc"), ("report", "log.csv", "-o", "page.html")]
)
@pytest.mark.parametrize("fails", [OSError(28, "No space left on device"), MemoryError()])
def test_a_failure_while_writing_leaves_nothing_half_written(words, fails, call, untouched, tmp_path, monkeypatch):
    """The disk fills, or memory ends, just before the finished file would get its name."""
    (tmp_path / "log.csv").write_text("t [s],p_A [Pa]\n" + "".join(f"{k / 500},{k % 7}\n" for k in range(500)))
    untouched()

    def fail(*_):
        raise fails

    monkeypatch.setattr("pathlib.Path.replace", fail)
    monkeypatch.setattr("os.replace", fail)
    done = call(*words)
    complaint = done.refused(done.status)
    assert done.status in (1, 2)
    assert ("No space left" if isinstance(fails, OSError) else "memory") in complaint
