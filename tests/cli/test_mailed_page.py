"""From a TDMS file to a PDF in a mail, by the commands that the README gives."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from email.message import EmailMessage
from email.parser import BytesParser
from email.policy import default
from pathlib import Path

import numpy as np
import pytest

from sealscope.errors import MissingExtra
from sealscope.reporting import printing

ROOT = Path(__file__).resolve().parents[2]


def commands() -> list[list[str]]:
    """The README's lines from a TDMS file to a mail."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"From a TDMS file to a PDF in a mail:\n\n```sh\n(.*?)```", text, re.DOTALL)
    return [shlex.split(line) for line in block.splitlines()]


def test_there_are_three_and_the_first_brings_what_reads_tdms() -> None:
    install, report, mail = commands()
    assert install == ["pip", "install", ".[io]"]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert any(name.startswith("npTDMS") for name in extras["io"])
    assert report[-1] in mail


@pytest.mark.slow
def test_a_tdms_file_becomes_a_mailed_pdf(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms", reason="the extra `io` is not installed")
    try:
        printing.print_page("<p>", tmp_path / "probe.pdf")
    except MissingExtra as error:
        pytest.skip(str(error))
    _, report, mail = commands()
    t = np.arange(0, 40, 0.002)
    rng = np.random.default_rng(5)
    properties = {"wf_increment": 0.002, "wf_start_offset": 0.0, "wf_samples": t.size}
    swing = np.sin(4 * t)
    channels = [
        nptdms.ChannelObject("bench", name, values + rng.normal(0, noise, t.size), {**properties, "unit_string": unit})
        for name, unit, values, noise in (
            ("Pressure A", "bar", 3 + 0.6 * swing, 0.02),
            ("Pressure B", "bar", 3 - 0.6 * swing, 0.02),
            ("Position", "mm", 50 * swing, 0.01),
        )
    ]
    with nptdms.TdmsWriter(tmp_path / report[2]) as writer:
        about = nptdms.RootObject({"operator": "A. B.", "machine": "Actuator 7", "oil temperature": "41 degC"})
        writer.write_segment([about, *channels])
    done = subprocess.run(
        [sys.executable, "-m", "sealscope", *report[1:]], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    pdf = (tmp_path / report[-1]).read_bytes()
    assert pdf.startswith(b"%PDF-")
    message = EmailMessage()
    message["To"] = mail[-1]
    message.add_attachment(pdf, maintype="application", subtype="pdf", filename=report[-1])
    received = BytesParser(policy=default).parsebytes(message.as_bytes())
    (attached,) = received.iter_attachments()
    assert attached.get_content() == pdf and len(message.as_bytes()) < 1_000_000  # small enough for any mail
