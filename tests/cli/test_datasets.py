"""`sealscope datasets`."""

from __future__ import annotations


def test_the_list_and_the_check_on_the_command_line(call, tmp_path):
    done = call("datasets")
    assert (done.status, done.err) == (0, "")
    assert [line for line in done.out.splitlines() if line[0] != " "] == ["vtnsi-actuator", "zema-hydraulic"]
    done = call("datasets", "zema-hydraulic")
    assert "10.1109/I2MTC.2015.7151267" in done.out and "CC BY 4.0" in done.out
    (tmp_path / "profile.txt").write_text("1\n")
    done = call("datasets", "zema-hydraulic", tmp_path)
    assert done.out.startswith("zema-hydraulic: 0 files with the right checksum, 1 with a wrong one,\n7 missing")
    assert done.refused().startswith("files must have their checksums, got a wrong one of ")
