"""Calls that cannot be done: wrong words, impossible machines, places that cannot be written."""

from __future__ import annotations

import pytest

import sealscope

from ..refusals import mentions

SIMULATE = ("simulate", "-o", "run.nc", "--duration", "5")
THROTTLED = ("--set", "orifices=present", "--set", "closed_A=50 %", "--set", "closed_B=50 %")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("--set", "V_1=-3"), "V_1, -3.0, --set"),
        (("--set", "L_c=0"), "L_c, 0.0, --set"),
        (("--set", "V_1=50[bar]"), "V_1, bar, --set"),
        (("--set", "V_1=nan"), "V_1, nan, --set"),
        (("--set", "wibble=3"), "'wibble'"),
        (("--set", "noise=3"), "noise, sensors.p_A.noise"),
        (("--set", "V_1"), "override, 'V_1'"),
        (("--set", "V_1=5e-5", "--set", "V_1=6e-5"), "V_1, 5e-5, 6e-5"),
        (("--set", "orifices=maybe"), "orifices"),
        (("--command", "11 sin(4t)"), "command, +-10 V"),
        (("--command", "step 10.5 at 2 s"), "command, 10.5 V, 2 s"),
        (("--command", "wobble"), "command, '3 sin(4t)'"),
        (("--leak", "50 L/min"), "leak, pump, 0.5854 L/min"),
        (("--leak", "a lot"), "leak, '0.0042 L/min from 90 s'"),
        (("--leak", "0.01 bar/s"), "leak"),
        (("--leak", "0.01 L/min from 9 s"), "leak, open, 0.01 L/min"),
        (("--leak", "-0.01 L/min"), "leak, '0.0042 L/min from 90 s'"),
        (("--leak", "0.01 L/min growing from 3 s to 2 s"), "leak, growing"),
        (("--rig", "nowhere"), "'nowhere', servo-valve, thesis"),
        (("--rig", "absent.toml"), "rig file, No such file or directory, absent.toml"),
        (("--rig", "unsourced.toml"), "q_b, none, unsourced.toml"),
        (("--rig", "broken.toml"), "TOML, broken.toml"),
        (("--duration", "0"), "duration, 0.0"),
        (("--duration", "soon"), "duration, 'soon'"),
        (("--duration", "5[m]"), "duration, m"),
        (("--duration", "1e12"), "duration, daq.sample_rate, 20000000"),
        (("--step", "-1"), "step, -1.0"),
        (("--step", "1[V]"), "step, V"),
        (("--seed", "-1"), "seed, -1"),
        (("--method", "euler"), "method, 'euler'"),
        (("--method", "imex"), "imex, throttles"),
        (("--start-position", "2"), "x_0, 2.0"),
        (("--fmu", "eha.fmu", "--map", " p_A = a", "--map", "p_A=b"), "--map, p_A, a, b"),
        (("--fmu", "eha.fmu", "--map", "p_A= "), "--map, p_A="),
        (("-o", "nowhere/run.nc"), "folder, nowhere, nowhere/run.nc"),
        (("-o", "run.xls"), ".nc"),
        (("--truth", "nowhere/truth.json"), "folder, nowhere"),
        (("--truth", "run.nc"), "truth, run.nc"),
    ],
)  # fmt: skip
def test_a_simulation_that_cannot_be(words, names, call, untouched, tmp_path):
    (tmp_path / "unsourced.toml").write_text(
        '[rig]\nextends = "thesis"\n[pump]\nq_b = { value = 5, unit = "cm^3/rev" }\n'
    )
    (tmp_path / "broken.toml").write_text("[rig\n")
    untouched()
    done = call(*SIMULATE, *words)
    assert mentions(done.refused(2), *names.split(", "))
    assert done.out == ""


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ((*THROTTLED, "--prove", "--method", "rk4", "--step", "1e-4"), "rk4, throttles"),
        ((*THROTTLED, "--method", "rk4", "--step", "1e-4"), "rk4, throttles"),
        (("--prove", "--step", "0.01"), "speed loop, oil columns, friction"),
        (("--prove", "--step", "0.0015"), "under-resolved, 0.001 s, rk4"),
        (("--set", "k_p=50000", "--set", "K_i=100"), "speed loop"),
        (("--command", "ramp 8 to 0.5 s", "--start-position", "0.28"), "vacuum"),
    ],
)  # fmt: skip
def test_a_run_that_cannot_be_trusted_fails_and_leaves_nothing(words, names, call, untouched):
    done = call(*SIMULATE, *words)
    assert mentions(done.refused(1), *names.split(", "))
    assert done.out == ""


def test_an_unresolved_run_comes_through_only_when_asked_for_and_is_marked(call, tmp_path):
    done = call(
        "simulate", "-o", tmp_path / "run.nc", "--duration", 5, "--step", 0.0015, "--prove", "--allow-unresolved"
    )
    assert done.status == 0
    assert "NOT RESOLVED" in done.out
    assert sealscope.read(tmp_path / "run.nc").provenance["solver"]["allow_unresolved"] is True


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("diagnose", "log.csv", "--false-alarm", "3"), "false-alarm probability, 3.0"),
        (("diagnose", "log.csv", "--false-alarm", "nan"), "false-alarm probability, nan"),
        (("diagnose", "log.csv", "--rate", "0"), "rate, 0.0"),
        (("diagnose", "log.csv", "--map", "p_A"), "map, CHANNEL=COLUMN"),
        (("diagnose", "log.csv", "--map", "P=a"), "channel, u"),
        (("diagnose", "log.csv", "--map", "p_A=a", "--map", "p_A=b"), "--map, p_A, a, b"),
        (("diagnose", "log.csv", "--baseline"), "--baseline, none"),
        (("diagnose", "--baseline", "--rate", "5", "log.csv"), "--baseline"),
        (("report", "log.csv", "-o", "nowhere/page.html"), "folder, nowhere"),
        (("report", "log.csv", "-o", "log.csv"), "page, log.csv"),
        (("report", "log.csv", "-o", "page.svg"), "page, page.svg"),
        (("report", "log.csv", "other.csv", "-o", "log.csv"), "log.csv"),
        (("report", "log.csv", "other.csv", "-o", "page.html"), "folder, page.html"),
        (("report", "log.csv", "./log.csv", "-o", "pages"), "pages, pages/log.html"),
        (("trend", ".", "-o", "log.csv"), "trend, log.csv"),
        (("convert", "log.csv", "log.xls"), ".nc"),
        (("convert", "log.csv", "./log.csv"), "source, log.csv"),
        (("convert", "log.csv", "nowhere/log.nc"), "folder, nowhere"),
        (("fmu", "-o", "leak.fmu", "--sensor", "volume", "--step", "1 ms"), "--step, --sensor"),
        (("fmu", "-o", "leak.fmu", "--sensor", "volume", "--error", "1[Pa]"), "--error, --sensor"),
        (("fmu", "-o", "eha.fmu", "--rate", "100 Hz"), "--rate, --sensor"),
        (
            ("fmu", "-o", "leak.fmu", "--sensor", "volume", "--rate", "10 Hz"),
            "rate, 16 Hz",
        ),
        (
            ("parameters", "nowhere"),
            "'nowhere', servo-valve, thesis",
        ),
        (("parameters", "--set", "V_1=0"), "V_1, 0.0, --set"),
    ],
)
def test_a_call_that_breaks_a_rule(words, names, call, untouched, tmp_path):
    for name in ("log.csv", "other.csv"):
        (tmp_path / name).write_text("t [s],p_A [Pa]\n" + "".join(f"{k / 500},{k % 7}\n" for k in range(50)))
    untouched()
    done = call(*words)
    assert mentions(done.refused(2), *names.split(", "))
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
