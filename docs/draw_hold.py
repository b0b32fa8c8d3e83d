"""Draw `docs/howto/hold.svg`, the trace of a hold test with its fit: python docs/draw_hold.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import sealscope as ss
from sealscope.reporting.hold import draw_curve

STYLES = {
    "grid": "stroke:#ddd", "frame": "fill:none;stroke:#888", "healthy": "fill:#2a7f4f;opacity:.25",
    "point other": "fill:#b5651d", "course": "fill:none;stroke:#1f4e8c;stroke-width:2",
}  # fmt: skip


def main() -> None:
    """Judge a made hold of ten minutes with an encoder of 0.1 mm, and write its picture."""
    random = np.random.default_rng(4)
    t = np.arange(0.0, 600.0, 0.1)
    travel = 0.8e-3 * t / 60.0 + 4e-4 * -np.expm1(-t / 15.0)
    x = np.round((0.4 - travel + 3e-5 * random.standard_normal(t.size)) / 1e-4) * 1e-4
    pressure = 8e6 + 1e4 * random.standard_normal(t.size)
    values, units = {"x": x, "p_A": pressure, "T_oil": 320.0 + 0.0 * t}, {"x": "m", "p_A": "Pa", "T_oil": "K"}
    (result,) = ss.hold_test(ss.Recording(t, values, units, rate=10.0), area=("3117 mm^2", "2155 mm^2"))
    picture = draw_curve(result.curve)
    paths = [f'<path style="{STYLES.get(shape.style, "")}" d="{shape.path}"/>' for shape in picture.shapes]
    labels = [
        f'<text x="{label.x:.1f}" y="{label.y:.1f}" text-anchor="{label.anchor}">{label.text}</text>'
        for label in picture.labels
    ]
    title = f'<text x="12" y="22">travel [mm]: {result.reason}</text>'
    font = 'font-family="sans-serif" font-size="12"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{picture.view_box}" {font}>'
    text = "\n".join([svg, *paths, *labels, title, "</svg>", ""])
    (Path(__file__).parent / "howto" / "hold.svg").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
