"""Print the lowest versions that pyproject.toml states, as constraints for pip: `numpy>=2.1` becomes `numpy==2.1`."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
extras = project["optional-dependencies"]
installed = ("io", "report", "pdf", "cluster", "serve", "mqtt", "postgres")
for requirement in dict.fromkeys(project["dependencies"] + [line for extra in installed for line in extras[extra]]):
    print(re.sub(r"\[.*?\]", "", requirement).replace(">=", "=="))
