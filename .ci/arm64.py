"""Check that the Containerfile's image can be installed on arm64: each package has a wheel there, so none is compiled.

    python .ci/arm64.py

pip resolves, for Linux on aarch64, what the image installs, and downloads what its index does not describe; nothing is
installed. Ends with pip's error where a package has no wheel.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib

from containerfile import ROOT, instructions, python_of
from packaging.requirements import Requirement

#: Versions of glibc up to that of Debian 12.
_GLIBC = (17, 24, 26, 27, 28, 31, 34, 35)


def requirements() -> list[str]:
    """List what the image installs on arm64, by name and version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    steps = instructions((ROOT / "Containerfile").read_text(encoding="utf-8"))
    install = next(text for kind, text in steps if kind == "RUN" and "pip install" in text)
    extras = re.search(r"\[(.*)\]", install)[1].split(",")
    stated = project["dependencies"] + [line for extra in extras for line in project["optional-dependencies"][extra]]
    machine = {"platform_machine": "aarch64", "sys_platform": "linux"}
    found = [Requirement(line) for line in dict.fromkeys(stated)]
    kept = [requirement for requirement in found if not requirement.marker or requirement.marker.evaluate(machine)]
    return [str(requirement).partition(";")[0] for requirement in kept]


def main() -> None:
    """Resolve the image's packages for arm64."""
    steps = instructions((ROOT / "Containerfile").read_text(encoding="utf-8"))
    words = ["--python-version", python_of(steps[0][1]), "--implementation", "cp", "--only-binary=:all:"]
    words += [word for minor in _GLIBC for word in ("--platform", f"manylinux_2_{minor}_aarch64")]
    words += ["--platform", "manylinux2014_aarch64", "--dry-run", "--ignore-installed", "-q"]
    with tempfile.TemporaryDirectory() as folder:
        pip = [sys.executable, "-m", "pip", "install", *words, "--target", folder, *requirements()]
        subprocess.run(pip, check=True)
    print(f"all of {len(requirements())} packages, and those they need, have wheels for arm64")


if __name__ == "__main__":
    main()
