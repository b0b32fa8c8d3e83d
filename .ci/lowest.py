"""Print the lowest versions that pyproject.toml states, as constraints for pip: `numpy>=2.1` becomes `numpy==2.1`."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
extras = project["optional-dependencies"]
for requirement in dict.fromkeys(project["dependencies"] + extras["io"] + extras["report"] + extras["cluster"]):
    print(re.sub(r"\[.*?\]", "", requirement).replace(">=", "=="))
