"""Check the Containerfile where no container can be run: parse it, and carry out its commands in a fresh environment.

    python .ci/containerfile.py PYTHON FOLDER

PYTHON makes the environment; everything is written below FOLDER, which stands for the image's root. `useradd` and
`chown`, which need an image, are left out. Ends with an error where a command fails, a copied file is not there, the
demo finds no leak, or the monitor's demo raises no alarm within three minutes.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_FOLDERS = ("/source", "/data", "/tmp")
_FOLDER = re.compile(rf"(?<![\w/])(?:{'|'.join(_FOLDERS)})\b")
_NEEDS_AN_IMAGE = ("useradd", "chown")
_LONGEST_S = 180.0


def instructions(text: str) -> list[tuple[str, str]]:
    """Return the instructions of a Containerfile, continued lines joined, comments left out."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    split = [line.split(maxsplit=1) for line in joined if line.strip()]
    return [(words[0].upper(), words[1].strip()) for words in split]


def python_of(base: str) -> str:
    """Return the version of Python of an image such as `docker.io/library/python:3.13-slim`."""
    name, _, tag = base.rpartition(":")
    if not name.endswith("/python"):
        raise SystemExit(f"the image must be one of Python, got {base}")
    return tag.partition("-")[0]


def main(python: str, folder: Path) -> None:
    """Carry out the Containerfile with the interpreter `python` below `folder`."""
    steps = instructions((ROOT / "Containerfile").read_text(encoding="utf-8"))
    assert steps[0][0] == "FROM", steps[0]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    supported = {line.rpartition(" ")[2] for line in project["classifiers"] if "Python :: 3." in line}
    assert python_of(steps[0][1]) in supported, (steps[0][1], supported)

    for name in _FOLDERS:
        (folder / name[1:]).mkdir(parents=True)
    subprocess.run([python, "-m", "venv", folder / "venv"], check=True)
    path = f"{folder}/venv/bin:{os.environ['PATH']}"
    surroundings = {**os.environ, "PATH": path, "SEALSCOPE_CACHE_DIR": f"{folder}/cache"}
    surroundings.pop("PYTHONPATH", None)
    place = folder
    entry: list[str] = []
    for kind, text in steps[1:]:
        if kind == "COPY":
            *sources, target = shlex.split(text)
            for source in map(ROOT.joinpath, sources):
                to = folder / target[1:]
                if source.is_dir():
                    shutil.copytree(source, to, dirs_exist_ok=True)
                else:
                    shutil.copy(source, to)
        elif kind == "WORKDIR":
            place = folder / text[1:]
        elif kind == "RUN":
            commands = [part.strip() for part in text.split("&&")]
            if any(command.split()[0] in _NEEDS_AN_IMAGE for command in commands):
                print("left out:", text)
                continue
            here = _FOLDER.sub(lambda match: f"{folder}{match[0]}", text)
            print("runs:", here, flush=True)
            subprocess.run(["sh", "-ec", here], cwd=place, env=surroundings, check=True)
        elif kind == "ENTRYPOINT":
            entry = json.loads(text)
        elif kind == "CMD":
            words = [*entry, *json.loads(text)]
            demo = subprocess.run(words, cwd=place, env=surroundings, capture_output=True, text=True, check=False)
            print(demo.stdout.splitlines()[0], demo.stderr, sep="\n", flush=True)
            assert demo.returncode == 0 and "recording.nc: leak" in demo.stdout.splitlines(), demo.stdout
        else:
            assert kind in ("USER", "STOPSIGNAL", "EXPOSE"), kind
    monitor = subprocess.Popen(
        [*entry, "monitor", "demo", "--port", "0"], cwd=place, env=surroundings, stdout=subprocess.PIPE, text=True
    )
    signal.alarm(int(_LONGEST_S))  # ends this process where no alarm comes
    try:
        assert monitor.stdout is not None
        event = next(json.loads(line) for line in monitor.stdout if line.startswith("{"))
        print("monitor:", event["event"], event["alarm"]["actuator"], f"{event['alarm']['leak_lpm']:.4f} L/min")
        assert event["alarm"]["actuator"] == "press 2"
        monitor.send_signal(signal.SIGTERM)
        assert monitor.wait(30) == 0, monitor.returncode
    finally:
        monitor.kill()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve())
