"""All speed benchmarks with one command: peers built, trajectories compared, ratios printed, figures kept.

    python benchmarks/run.py [--quick] [--into FOLDER]

Writes solvers.json, solvers.svg (work-precision plot; needs matplotlib) and variants.json into `benchmarks/results` or
the folder that is given.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def main() -> None:
    """Run the scripts in turn, each in a process of its own, on one thread."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two rounds, two rigs, few runs: to see that all works")
    parser.add_argument("--into", type=Path, default=HERE / "results", help="folder of the figures")
    chosen = parser.parse_args()
    results = chosen.into
    solvers = ["bench_solvers.py", "--json", str(results / "solvers.json")]
    if importlib.util.find_spec("matplotlib"):
        solvers += ["--plot", str(results / "solvers.svg")]
    else:
        print("no work-precision plot: matplotlib is not installed (pip install 'sealscope[report]')", file=sys.stderr)
    if chosen.quick:
        solvers += ["--rounds", "2", "--duration", "20", "--case", "no throttles, 3 sin 4t"]
        solvers += ["--case", "50 % closed, 3 sin 4t"]
    variants = ["bench_variants.py", "--json", str(results / "variants.json")]
    if chosen.quick:
        variants += ["--rounds", "1", "--duration", "20"]
    print(f"{platform.machine()}, {platform.python_implementation()} {platform.python_version()}", flush=True)
    failed = [
        words[0]
        for words in (solvers, variants)
        if subprocess.run([sys.executable, str(HERE / words[0]), *words[1:]], check=False).returncode
    ]
    if failed:
        raise SystemExit(f"these ended in an error: {', '.join(failed)}")


if __name__ == "__main__":
    main()
