"""The page: well-formed, self-contained, safe, true to the diagnosis, and small."""

from __future__ import annotations

import json
import re
from base64 import b64decode, b64encode
from dataclasses import replace
from hashlib import sha256

import numpy as np
import pytest

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import Evidence, LeakCourse
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.quality import Finding
from sealscope.reporting.charts import Mark, draw
from sealscope.reporting.page import render_page, report
from sealscope.reporting.particulars import collect_particulars
from sealscope.reporting.schematic import build_circuit, schematic

from ..refusals import refusal
from ..wording import says
from .pages import Reader

EVIL = '"><script>alert(1)</script><img src=x onerror=alert(2)>{{ 7*7 }}</script>'


def chart_data(reader):
    return json.loads(reader.scripts[0])


def drawn(series):
    q = np.frombuffer(b64decode(series["q"]), dtype="<i2").astype(float)
    return np.where(q == -32768, np.nan, series["low"] + (q + 32767) * series["step"])


@pytest.fixture(scope="module")
def page(recording, make_diagnosis):
    return render_page(recording, make_diagnosis(), truth_onset_s=20.0, truth_leak_lpm=0.0043, marks=[Mark(5, "cold")])


@pytest.fixture(scope="module")
def reader(page):
    return Reader(page)


def test_the_page_asks_nothing_of_a_network(page, reader):
    assert all(target.startswith("#") and target[1:] in reader.ids for target in reader.targets)
    assert not re.search(r"@import|url\((?!#)", page)
    assert "default-src 'none'" in page and "connect-src" not in page


def test_only_the_two_scripts_of_this_project_may_run(page, reader):
    policy = re.search(r"script-src ([^;]*);", page).group(1)
    hashes = {f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'" for code in reader.scripts[1:]}
    assert len(reader.scripts) == 3 and set(policy.split()) == hashes
    assert reader.handlers == []


def test_ids_are_unique_and_every_table_has_a_caption(reader):
    assert len(reader.ids) == len(set(reader.ids))
    assert reader.tables and all(reader.tables)


def test_the_numbers_are_the_diagnosis_own(reader):
    assert reader.values["20.375"] == "20.4 s, between 18.5 s and 21.8 s"
    assert reader.values["0.00421"] == "0.00421 L/min, between 0.0031 and 0.0057 L/min"
    assert "5.44" in reader.values["5.4375"] and "3.22" in reader.values["3.21875"]
    for said in ("d3 fell in both chambers", "12 samples stand at the rail", "the RMS of d3 of p_A fell by 31 %",
                 "0.1 % (1 in 1000)", "bench 4", "converted with 14 bits", "the onset found is 0.4 s late",
                 "the leak is 0.0043 L/min on average", "cold (5.0 s)"):  # fmt: skip
        assert said in reader.text


def test_the_marks_and_the_onset_are_on_the_charts(reader):
    data = chart_data(reader)
    assert data["onset"] == {"t": 20.375, "low": 18.5, "high": 21.75}
    assert data["marks"] == [
        {"t": 5, "label": "cold", "known": False},
        {"t": 20.0, "label": "true onset", "known": True},
    ]


def test_what_is_drawn_is_what_was_recorded(reader, recording):
    charts = {chart["key"]: chart for chart in chart_data(reader)["charts"]}
    p_A, p_B = charts["p_AB-0"]["series"]
    assert charts["p_AB-0"]["unit"] == "bar"
    for series, name in ((p_A, "p_A"), (p_B, "p_B")):
        line, values = drawn(series), recording[name] / 1e5
        assert np.nanmax(line) == pytest.approx(values.max(), rel=1e-6)
        assert np.nanmin(line) == pytest.approx(values.min(), rel=1e-6)
    assert {"u-0", "x-0", "omega-0", "p_12-0", "q_leak-0", "rms-p_A", "rms-p_B-d3d4", "d1-p_A", "d3d4-p_B"} <= set(
        charts
    )
    assert charts["x-0"]["unit"] == "mm" and charts["d3d4-p_A"]["unit"] == "kPa²"


def test_each_chart_has_its_place_and_a_still_picture(page, reader):
    for chart in chart_data(reader)["charts"]:
        assert page.count(f'data-chart="{chart["key"]}"') == 1
    assert page.count('<svg class="still"') == len(chart_data(reader)["charts"])


def test_another_pressure_unit_and_a_wrong_one(recording, make_diagnosis):
    data = chart_data(Reader(render_page(recording, make_diagnosis(), pressure_unit="psi")))
    chart = next(c for c in data["charts"] if c["key"] == "p_AB-0")
    assert chart["unit"] == "psi"
    assert np.nanmax(drawn(chart["series"][0])) == pytest.approx(recording["p_A"].max() / 6894.757, rel=1e-6)
    with refusal("'torr'", "bar", "psi"):
        render_page(recording, make_diagnosis(), pressure_unit="torr")


def test_counts_stay_counts(recording, make_diagnosis):
    counts = replace(recording.only(["p_A"]), units={"p_A": "count"})
    chart = next(c for c in chart_data(Reader(render_page(counts, make_diagnosis())))["charts"] if c["key"] == "p_AB-0")
    assert chart["unit"] == "counts"
    assert np.nanmax(drawn(chart["series"][0])) == pytest.approx(counts["p_A"].max(), rel=1e-6)


def test_names_that_try_to_be_markup_are_text(recording, make_diagnosis, tmp_path):
    bad = Finding(EVIL, "warning", EVIL, 1, 0.0, EVIL)
    method = Evidence("leak", EVIL, 1.0, 2.0, detector=EVIL)
    hostile = replace(recording, provenance={EVIL: EVIL, "deep": {"er": [EVIL]}}, history=(EVIL,))
    diagnosis = make_diagnosis(file=EVIL, reason=EVIL, quality=(bad,), parts=(method,))
    file = tmp_path / "evil.toml"
    file.write_text(f"[rig]\nextends = 'thesis'\ntitle = '{EVIL}'\n", encoding="utf-8")
    read = Reader(render_page(hostile, diagnosis, marks=[Mark(1.0, EVIL)], rig=file))
    assert len(read.scripts) == 3 and read.handlers == []
    assert read.text.count(EVIL) > 5  # in full and as it is: not run, not filled in
    assert chart_data(read)["marks"][0]["label"] == EVIL and "<" not in read.scripts[0]


def test_missing_channels_and_none_everywhere(recording, no_verdict, make_diagnosis):
    for names in ([], ["u"], ["p_B"], ["p_A", "q_leak"]):
        for part in (recording.only(names), recording.only(names).between(0, 0.06)):
            for diagnosis in (no_verdict, make_diagnosis()):
                text = Reader(render_page(part, diagnosis)).text
                assert "None" not in text and "nan" not in text.split()
    assert "p_A is not in this recording." in Reader(render_page(recording.only(["u"]), no_verdict)).text


def test_faulty_data_are_drawn_and_named_not_refused(recording, make_diagnosis):
    values = recording["p_A"].copy()
    values[3000:3400] = np.nan
    values[50] = np.inf
    t = recording.t.copy()
    t[9000] = t[8000]
    faulty = replace(
        recording, t=t, channels={**recording.channels, "p_A": values, "x": np.full(len(recording), np.nan)}
    )
    read = Reader(render_page(faulty, make_diagnosis()))
    assert "time stamps are out of order" in read.text and "samples are left out" in read.text
    line = drawn(next(c for c in chart_data(read)["charts"] if c["key"] == "p_AB-0")["series"][0])
    assert np.isnan(line).any() and not any(c["key"] == "x-0" for c in chart_data(read)["charts"])
    item = replace(recording, t=[0.0], channels={"p_A": [3e5]}, units={"p_A": "Pa"})
    Reader(render_page(item, make_diagnosis()))
    with refusal("1 sample"):
        render_page(recording.between(-2, -1), make_diagnosis())


@pytest.mark.parametrize("kind", ["out of order", "missing"])
def test_without_times_in_order_all_samples_in_the_middle_are_drawn(make_recording, make_diagnosis, kind):
    """The axis is the sample's number over the rate, from 0 s on, whatever the stamps begin with."""
    recording = make_recording(80.0)
    t = recording.t + 1000.0
    t[len(t) // 2] = t[5] if kind == "out of order" else np.nan
    drawn_charts = draw(replace(recording, t=t), [], [], make_diagnosis(onset_s=None), ())
    assert drawn_charts.base.width > 1 and drawn_charts.span == (0.0, pytest.approx(80.0, abs=0.01))
    assert drawn_charts.fine == pytest.approx((40.0 - 6.0, 40.0 + 6.0), abs=0.01)  # 6000 samples of 500 Hz


def test_an_unbounded_interval_is_drawn_to_the_recordings_end(recording, make_diagnosis):
    diagnosis = make_diagnosis(onset_interval_s=(18.5, np.inf), leak_interval_lpm=(0.003, np.inf))
    read = Reader(render_page(recording, diagnosis))
    assert chart_data(read)["onset"]["high"] == pytest.approx(recording.t[-1])
    assert says(read.text, "how_much.interval", low="0.003", high="∞")


@pytest.mark.parametrize("verdict", ["leak", "no leak", "cannot tell"])
def test_the_schematic_highlights_the_leak_path_only_for_a_leak(recording, make_diagnosis, verdict):
    page = render_page(recording, make_diagnosis(verdict=verdict))
    assert ('class="leak"' in page) == (verdict == "leak")
    assert ("leak 0.00421 L/min" in page) == (verdict == "leak")


def test_the_schematic_tells_recorded_sensors_from_others_and_shows_the_rigs_values(recording, make_diagnosis):
    page = render_page(recording.only(["p_A"]), make_diagnosis())
    assert "in chamber A, p_A, in this recording" in page and "in chamber B, p_B, not in this recording" in page
    rig = load_rig("thesis").with_overrides({"cylinder.A_B": 500e-6})
    text = Reader(render_page(recording, make_diagnosis(), rig=rig)).text
    for value in ("633 mm² at A and 500 mm² at B", "600 mm", "4.9 cm³/rev", rig.title):
        assert value in text
    assert "4.9 cm³/rev" in Reader(render_page(recording, make_diagnosis(), rig="thesis")).text


def circuit(recording, **overrides):
    rig = load_rig("thesis").with_overrides(overrides)
    drawing = build_circuit(rig, recording)
    return drawing, Reader(schematic(recording, _judged(), drawing))


def _judged():
    return Diagnosis("no leak", "", false_alarm_probability=0.01)


def test_the_drawing_is_the_machines_own(recording):
    """Areas that differ make a single-rod cylinder; what the rig has not is not drawn."""
    double, read = circuit(recording.only(["p_A"]))
    assert (double.rods, double.throttles, double.make_up, double.bypass) == ("AB", False, False, False)
    assert "double-rod cylinder" in read.text and "throttle" not in read.text and "needle valve" not in read.text
    single, read = circuit(recording, **{"cylinder.A_B": 316.5e-6, "makeup.check_valves": "present"})
    assert single.rods == "B"
    assert single.rod == pytest.approx(78 * 0.5**0.5, abs=0.1)  # the rod's thickness follows from the areas
    assert "single-rod cylinder" in read.text and "The rod leaves chamber B." in read.text
    assert "accumulator" in read.text and "needle valve" in read.text  # the flow meter was recorded
    assert circuit(recording, **{"cylinder.A_A": 316.5e-6})[0].rods == "A"
    piloted, read = circuit(recording, **{"makeup.check_valves": "pilot-operated"})
    assert piloted.make_up and "accumulator" in read.text
    assert "one-way throttle A" in circuit(recording, **{"line.orifices": "present"})[1].text
    unknown = build_circuit(None, recording)
    assert (unknown.cylinder, unknown.throttles) == ("cylinder", False)


@pytest.mark.parametrize("ratio", [0.89, 0.9, 0.91, 0.93, 0.96])
def test_a_single_rod_is_drawn_where_the_rig_has_one(recording, ratio):
    rig = load_rig("thesis").with_overrides({"cylinder.A_B": ratio * 633e-6, "makeup.check_valves": "present"})
    assert (build_circuit(rig, recording).cylinder == "single-rod cylinder") == rig.cylinder.single_rod


def test_a_servo_valve_is_drawn_between_supply_and_return(recording):
    drawing = build_circuit(load_rig("servo-valve"), recording)
    text = Reader(schematic(recording, _judged(), drawing)).text
    assert "servo valve" in text and "pressure of the supply, p_1" in text and "pressure of the return, p_2" in text
    assert "servo drive" not in text and "port 1" not in text
    assert "A servo valve joins the chambers A and B of a double-rod cylinder to a supply and a return." in text


def test_sensors_carry_the_files_own_names(recording, make_diagnosis):
    named = replace(recording, provenance={"columns": {"p_A": "Druck A [bar]", "q": "no channel"}})
    text = Reader(render_page(named, make_diagnosis())).text
    assert "in chamber A, p_A, in this recording as Druck A [bar]" in text
    assert "column Druck A [bar]" in text and "no channel" not in text.split("Where the recording")[0]


def test_signs_that_a_terminal_obeys_are_replaced(recording, make_diagnosis):
    about = {"Test\x9b2J": "a\x1b]0;title\x07\x1b[31m", "Operator": "a \u202egnp.exe", "Line": "one\r\ntwo\tthree"}
    page = render_page(replace(recording, provenance={"about": about}), make_diagnosis(file="odd\x1b[2J.nc"))
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", page)
    assert "\N{REPLACEMENT CHARACTER}[31m" in page


def test_machine_date_operator_and_oil_stand_under_the_title(recording, make_diagnosis):
    about = {"Bediener": "A. B.", "Test": "weekly", "Öltemperatur": "41 °C", "Prüfling": "Press 7"}
    known = replace(recording, provenance={"about": about, "start": "2026-05-31T14:05:00.250000000"})
    particulars = collect_particulars(known)
    assert list(particulars.items()) == [
        ("Machine", "Press 7"),
        ("Date", "2026-05-31 14:05:00"),
        ("Operator", "A. B."),
        ("Oil temperature", "41 °C"),
    ]
    page = render_page(known, make_diagnosis())
    assert page.index("Press 7") < page.index('class="verdict') and "A. B." in page
    assert collect_particulars(replace(recording, provenance={}), load_rig("thesis")).get("Date") is None
    assert collect_particulars(recording, load_rig("thesis")).get("Machine") == "EHA test rig of the thesis"


def test_no_legend_is_empty(page, reader):
    """Each key names its lines; the values appear with the cursor."""
    assert "legend: {show: false}" in reader.scripts[-1]
    keys = re.findall(r'<span class="key">(.*?)<span class="at">', page)
    assert keys and all("<output></output>" in key for key in keys)
    (pressures,) = [key for key in keys if ">p_A <" in key]
    assert ">p_B <" in pressures and pressures.count("<path") == 2


def test_three_minutes_at_500_hz_stay_under_two_megabytes(make_recording, make_diagnosis):
    long = make_recording(seconds=180.0)
    page = render_page(long, make_diagnosis(onset_s=90.0, onset_interval_s=(88.0, 93.0)))
    assert len(page.encode()) < 2_000_000
    assert "Of each 12 samples in turn (24 ms)" in page and "from 84.0 s to 96.0 s every sample is drawn" in page


def test_the_page_is_the_same_twice(recording, make_diagnosis):
    assert render_page(recording, make_diagnosis()) == render_page(recording, make_diagnosis())


def test_a_page_is_written_whole_or_not_at_all(tmp_path, recording, make_diagnosis, monkeypatch):
    target = tmp_path / "page.html"
    assert report(recording, target, make_diagnosis()) == target
    assert target.read_text(encoding="utf-8") == render_page(recording, make_diagnosis())
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]
    before = target.read_bytes()

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        report(recording, target, make_diagnosis(verdict="no leak"))
    assert target.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path, recording, make_diagnosis):
    with refusal("absent"):
        report(recording, tmp_path / "absent" / "page.html", make_diagnosis())


@pytest.mark.parametrize("name", ["page.svg", "page.html.gz", "page"])
def test_a_page_is_a_page_and_nothing_else(tmp_path, recording, make_diagnosis, name):
    with pytest.raises(InputError, match=rf"^a page's name must end in \.html, \.htm, \.pdf, \.png, got .*{name}$"):
        report(recording, tmp_path / name, make_diagnosis())
    assert list(tmp_path.iterdir()) == []
    assert report(recording, tmp_path / "page.HTM", make_diagnosis()).is_file()


def test_a_mark_must_stand_at_a_time():
    with refusal("'oil change'", "nan"):
        Mark(float("nan"), "oil change")


def course(**changed):
    values = {"t": np.linspace(2.0, 38.0, 19), "lpm": np.linspace(0.0, 0.004, 19)}
    values |= {"low": values["lpm"] - 0.001, "high": values["lpm"] + 0.001}
    return LeakCourse(**(values | changed))


def test_the_leak_is_drawn_over_time_with_its_band(recording, make_diagnosis):
    result = course()
    page = render_page(recording, make_diagnosis(course=result))
    chart = next(item for item in chart_data(Reader(page))["charts"] if item["key"] == "course")
    assert (chart["unit"], chart["band"]) == ("L/min", True)
    for series, values in zip(chart["series"], (result.lpm, result.low, result.high), strict=True):
        assert drawn(series) == pytest.approx(values, abs=1e-6)
    (still,) = re.findall(r'data-chart="course".*?</svg>', page, re.DOTALL)
    (band,) = re.findall(r'<path class="interval" d="([^"]*)"', still)
    assert len(re.findall("[ML]", band)) == 2 * result.t.size
    assert band.endswith("z")
    assert still.index('class="interval"') < still.index('class="line a"')  # the estimate above its interval
    assert len(re.findall('class="line ', still)) == 1  # the ends of the interval are no lines


def test_one_wide_interval_does_not_press_the_curve_flat(recording, make_diagnosis):
    wide = course()
    wide.low[0], wide.high[0] = -5.0, 5.0
    page = render_page(recording, make_diagnosis(course=wide))
    chart = next(item for item in chart_data(Reader(page))["charts"] if item["key"] == "course")
    low, high = chart["limits"]
    assert low < -0.0005 and 0.004 < high < 0.01
    assert "95 % interval, cut at the frame" in page
    (d,) = re.findall(r'<path class="frame"[^>]*>.*?<path class="interval" d="([^"]*)"', page)
    heights = [float(y) for y in re.findall(r"[ML]\S+ ([-\d.]+)", d)]
    assert min(heights) >= -0.1 and max(heights) <= chart["height"] + 0.1
    assert "cut at the frame" not in render_page(recording, make_diagnosis(course=course()))


def test_a_course_without_ends_or_without_anything(recording, make_diagnosis):
    endless = course(low=np.full(19, -np.inf), high=np.full(19, np.inf))
    page = render_page(recording, make_diagnosis(course=endless))
    assert not re.search(r' d="[^"]*(nan|inf)', page)
    assert 'data-chart="course"' in page
    empty = render_page(recording, make_diagnosis(course=course(lpm=np.full(19, np.nan))))
    assert 'data-chart="course"' not in empty
    assert "How large the leak is over time" not in empty
