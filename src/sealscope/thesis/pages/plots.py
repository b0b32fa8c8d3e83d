"""Figures as pictures: thesis products drawn for print, readable without colour (matplotlib, without a display)."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.thesis.engine.products import Figure, FigureCurve, Panel, Role, thinned
from sealscope.thesis.pages.plot_style import SAME_ROLE, SETTINGS, STYLES, caption, typeset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Canvas
    from matplotlib.legend import Legend

UNRESOLVED = "not resolved: halving the step moves it"
#: Most bytes of an SVG with its curves as curves; a larger one gets them as pixels.
MOST_SVG_BYTES = 380_000
DPI = 200
_WIDTH = 7.2
_POINTS = 2400
#: A line with more points than this is noise to the eye: drawn thin and without dashes.
_DENSE = 1500
#: ... and with more than this it becomes pixels in an SVG that is too large otherwise.
_LONG = 300
_POINT_BYTES = 15


def require_drawing() -> None:
    """Raise MissingExtra where the drawing library is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingExtra("figures need matplotlib: pip install 'sealscope[report]'") from None


def draw(figure: Figure) -> tuple[bytes, bytes]:
    """Draw the figure: an SVG whose text stays text, and a PNG with a palette at 200 dpi.

    Raises MissingExtra where matplotlib is not installed.
    """
    require_drawing()
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # not the settings in the working folder, which may be hostile and run TeX
        matplotlib.rcParams.update(matplotlib.rc_params_from_file(SETTINGS, use_default_template=False))
        matplotlib.rcParams["svg.hashsalt"] = figure.id
        canvas = _canvas(figure)
        long = [line for ax in canvas.axes for line in ax.lines if np.size(line.get_xdata()) > _LONG]
        large = sum(np.size(line.get_xdata()) for line in long) * _POINT_BYTES > MOST_SVG_BYTES
        svg = b"" if large else _svg(canvas, figure)
        if large or len(svg) > MOST_SVG_BYTES:
            for line in long:
                line.set_rasterized(True)
            svg = _svg(canvas, figure)
        return svg, _png(canvas, greys=any(panel.image is not None for panel in figure.panels))


def _svg(canvas: Canvas, figure: Figure) -> bytes:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    out = io.StringIO()
    canvas.set_dpi(DPI)  # of its pixels; printing leaves its own there
    FigureCanvasSVG(canvas).print_svg(
        out, metadata={"Title": caption(figure.id, figure.title), "Date": None, "Creator": None}
    )
    return out.getvalue().encode()


def _png(canvas: Canvas, *, greys: bool) -> bytes:
    """Draw as PNG with few colours for a small file; a picture of greys keeps a whole palette."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image as Picture

    canvas.set_dpi(DPI)
    agg = FigureCanvasAgg(canvas)
    agg.draw()
    out = io.BytesIO()
    with Picture.fromarray(np.asarray(agg.buffer_rgba())[..., :3]) as picture:
        method = Picture.Quantize.MEDIANCUT if greys else Picture.Quantize.FASTOCTREE
        few = picture.quantize(256, method=method, dither=Picture.Dither.NONE)
        few.save(out, format="PNG", compress_level=7, dpi=(DPI, DPI))
    return out.getvalue()


def grid_of(panels: int) -> tuple[int, int]:
    """Choose rows and columns of a figure's panels: one column up to five panels, two up to twelve, then three."""
    columns = 1 if panels <= 5 else 2 if panels <= 12 else 3
    return -(-panels // columns), columns


def _canvas(figure: Figure) -> Canvas:
    """Lay the figure out.

    From the top: the mark of an unresolved run, a legend that serves all panels, the panels, the caption.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    rows, columns = grid_of(max(1, len(figure.panels)))
    row_height = {1: 3.4, 2: 2.35, 3: 1.85, 4: 1.6}.get(rows, 1.35 if columns == 1 else 1.7)
    shared = _shared_legend(figure.panels)
    lines = textwrap.wrap(caption(figure.id, figure.title), 122)
    mark = 0.34 if figure.resolved is False else 0.0
    foot, head = 0.16 * len(lines) + 0.14, 0.03 + mark + (0.24 if shared else 0.0)
    height = rows * row_height + foot + head
    canvas = Canvas(figsize=(_WIDTH, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(canvas)
    engine: Any = canvas.get_layout_engine()
    engine.set(rect=(0, foot / height, 1, 1 - (foot + head) / height), h_pad=0.05, w_pad=0.06, hspace=0.03)
    axes = canvas.subplots(rows, columns, squeeze=False)
    same_marks = len({panel.marks for panel in figure.panels}) == 1
    for index, ax in enumerate(axes.flat):
        if index >= len(figure.panels):
            ax.set_axis_off()
            continue
        panel = figure.panels[index]
        _panel(canvas, ax, panel, mark_words=index < columns or not same_marks)
        if not shared:
            _legend(ax, panel)
    _hide_repeated_x_labels(axes, figure.panels)
    if shared:
        handles, labels = axes.flat[0].get_legend_handles_labels()
        anchor = (0.5, 1 - (0.03 + mark) / height)
        _plain(canvas.legend(handles, labels, loc="upper center", bbox_to_anchor=anchor, ncols=len(labels)))
    canvas.text(
        0.012, 0.06 / height, "\n".join(map(typeset, lines)), va="bottom", ha="left", fontsize=8.2, linespacing=1.25
    )
    if figure.resolved is False:
        box = {"boxstyle": "square,pad=0.35", "facecolor": "#fff3c4", "edgecolor": "#8f1d14", "linewidth": 1.6}
        canvas.text(
            0.988, 1 - 0.09 / height, UNRESOLVED.upper(), va="top", ha="right", fontsize=8.5, weight="bold",
            color="#5c0f08", bbox=box,
        )  # fmt: skip
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")
    return canvas


def _panel(canvas: Canvas, ax: Axes, panel: Panel, *, mark_words: bool) -> None:
    if panel.image is not None:
        image = panel.image
        mesh = ax.pcolormesh(image.x, image.y, image.values, cmap="Greys", shading="auto", rasterized=True)
        canvas.colorbar(mesh, ax=ax, label=typeset(image.label), pad=0.01, fraction=0.05)
        ax.grid(False)
    counts: dict[Role, int] = {}
    for curve in panel.curves:
        again = counts.get(curve.role, 0)
        counts[curve.role] = again + 1
        _curve(ax, curve, again, panel.x_range, len(panel.curves) == 1)
    for x, text in panel.marks:
        ax.axvline(x, color="#1b1f24", linewidth=0.8, dashes=(1.5, 1.5), zorder=4)
        if text and mark_words:
            ax.annotate(
                typeset(text), (x, 0.98), xycoords=("data", "axes fraction"), xytext=(2.5, 0), rotation=90,
                textcoords="offset points", va="top", ha="left", fontsize=6.8, color="#1b1f24", zorder=5,
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.4},
            )  # fmt: skip
    if panel.log_x:
        ax.set_xscale("log")
        _plain_numbers(ax.xaxis)
    if panel.log_y:
        ax.set_yscale("log")
        _plain_numbers(ax.yaxis)
    ax.set_xlabel(typeset(panel.x_label), labelpad=2)
    ax.set_ylabel(typeset(panel.y_label), labelpad=3)
    if panel.title:
        ax.set_title(typeset(panel.title), loc="left", pad=4)
    if panel.x_range is not None:
        ax.set_xlim(*panel.x_range)
    elif panel.image is None and all(curve.kind == "line" for curve in panel.curves):
        ax.margins(x=0)
    ax.tick_params(width=0.6, length=3)


def _plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with numbers such as 0.2, 1, 50, with powers of ten over many decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_minor_formatter(NullFormatter())
    low, high = sorted(axis.get_view_interval())
    if low > 0 and high / low < 1e4:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def visible(curve: FigureCurve, x_range: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Select the points of a curve as drawn: in the range with a neighbour on each side, a long line thinned."""
    x, y = np.asarray(curve.x, dtype=np.float64), np.asarray(curve.y, dtype=np.float64)
    if x_range is not None and x.size > _POINTS and np.all(np.diff(x) >= 0):
        first, last = np.searchsorted(x, sorted(x_range))
        x, y = x[max(0, first - 1) : last + 1], y[max(0, first - 1) : last + 1]
    return thinned(x, y, _POINTS) if curve.kind == "line" else (x, y)


def _curve(ax: Axes, curve: FigureCurve, again: int, x_range: tuple[float, float] | None, alone: bool) -> None:
    style = STYLES["other" if alone and curve.role == "reference" else curve.role]
    x, y = visible(curve, x_range)
    dense = x.size > _DENSE
    line: dict[str, Any] = {
        "color": style.colour,
        "linewidth": min(style.width, 0.6) if dense else style.width,
        "label": typeset(curve.label),
    }
    dashes = style.dashes if again == 0 else SAME_ROLE[again % len(SAME_ROLE)]
    if dashes and not dense:
        line["dashes"] = dashes
    marker: dict[str, Any] = {"marker": style.marker, "markersize": 4.2, "color": style.colour}
    if style.marker != "x":
        marker["markerfacecolor"] = style.colour if style.filled else "white"
    if curve.kind == "points":
        ax.plot(x, y, linestyle="none", label=line["label"], **marker)
    elif curve.kind == "stems":
        ax.vlines(x, 0, y, color=style.colour, linewidth=0.8)
        ax.plot(x, y, linestyle="none", label=line["label"], **{**marker, "markersize": 3})
        ax.axhline(0, color="#444b52", linewidth=0.6)
    else:
        ax.plot(x, y, **line)


def _shared_legend(panels: Sequence[Panel]) -> bool:
    """Return True if all panels show the same curves, so that one legend serves them."""
    keys = {tuple((curve.label, curve.role, curve.kind) for curve in panel.curves) for panel in panels}
    labels = [curve.label for curve in panels[0].curves] if panels else []
    short = sum(map(len, labels)) + 6 * len(labels) <= 100
    return len(panels) > 1 and len(keys) == 1 and len(labels) > 1 and short


def _legend(ax: Axes, panel: Panel) -> None:
    """Place the legend above the axes where it fits in a line, else beside them; none for a single named curve."""
    labels = [curve.label for curve in panel.curves if curve.label]
    if not labels or (len(panel.curves) == 1 and (not panel.title or labels[0] in panel.y_label)):
        return
    wide = sum(map(len, labels)) + 6 * len(labels) + len(panel.title)
    if wide <= 92 and len(labels) <= 5:
        legend = ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(labels), borderaxespad=0.1)
    else:
        legend = ax.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), borderaxespad=0.1)
    _plain(legend)


def _plain(legend: Legend) -> None:
    """Draw the lines in a legend thick enough to see, however thin the curves are."""
    for line in legend.get_lines():
        line.set_linewidth(max(1.3, line.get_linewidth()))


def _hide_repeated_x_labels(axes: Any, panels: Sequence[Panel]) -> None:
    """Label the x axis in the lowest panel of each column alone, where all panels share it."""
    visible_axes = [ax for ax in axes.flat if ax.axison]
    x_axes = {(ax.get_xlabel(), tuple(round(end, 9) for end in ax.get_xlim())) for ax in visible_axes}
    if len(x_axes) != 1 or any(panel.image is not None for panel in panels):
        return
    for column in axes.T:
        for above, below in pairwise(column):
            if below.axison:
                above.set_xlabel("")
                above.tick_params(labelbottom=False)
