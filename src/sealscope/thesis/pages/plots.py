"""Draw the thesis's figures for print, readable without colour (matplotlib, without a display)."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.thesis.engine.products import Figure, FigureCurve, Panel, thin_curve
from sealscope.thesis.pages.plot_style import SETTINGS, STYLES, caption, typeset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as MplFigure
    from matplotlib.legend import Legend

UNRESOLVED = "not resolved: halving the step moves it"
#: Largest SVG with all curves as paths [bytes]; in a larger SVG long curves are rasterised.
MAX_SVG_BYTES = 380_000
DPI = 200
#: Width of a figure, and heights of its parts [inch].
_WIDTH = 7.2
_TOP_MARGIN, _WARNING_HEIGHT, _LEGEND_HEIGHT = 0.03, 0.34, 0.24
_LINE_HEIGHT, _CAPTION_MARGIN = 0.16, 0.14
#: Number of panels, one below the other -> height of a panel [inch]; it is 1.35 for more panels.
_ROW_HEIGHTS = {1: 3.4, 2: 2.35, 3: 1.85, 4: 1.6}
_CAPTION_CHARACTERS = 122
#: Width [characters] of a label's line and margin in a legend, and of all labels above a figure.
_LABEL_MARGIN, _MAX_SHARED_CHARACTERS = 6, 100
#: Points to which a line is thinned.
_MAX_POINTS = 2400
#: A line with more points is drawn thin and without dashes, as it looks like noise.
_DENSE_POINTS = 1500
#: A line with more points is rasterised in an SVG that is too large otherwise.
_RASTER_POINTS = 300


def require_drawing() -> None:
    """Raise MissingExtra if matplotlib, which draws the figures, is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingExtra("figures need matplotlib: pip install 'sealscope[report]'") from None


def draw(figure: Figure) -> tuple[bytes, bytes]:
    """Draw a figure; return it as an SVG file with searchable text, and as a PNG file of `DPI` dots per inch.

    Raises MissingExtra if matplotlib is not installed.
    """
    require_drawing()
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # ignore settings in the working folder, which may be hostile and run TeX
        matplotlib.rcParams.update(matplotlib.rc_params_from_file(SETTINGS, use_default_template=False))
        matplotlib.rcParams["svg.hashsalt"] = figure.id  # equal figures give equal files
        mpl_figure = _draw_figure(figure)
        svg = _render_svg(mpl_figure, figure)
        if len(svg) > MAX_SVG_BYTES:
            for line in (line for ax in mpl_figure.axes for line in ax.lines):
                line.set_rasterized(np.size(line.get_xdata()) > _RASTER_POINTS)
            svg = _render_svg(mpl_figure, figure)
        return svg, _render_png(mpl_figure, has_image=any(panel.image is not None for panel in figure.panels))


def _render_svg(mpl_figure: MplFigure, figure: Figure) -> bytes:
    """Render a drawn figure as an SVG file without a date, so that equal figures give equal bytes."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    out = io.StringIO()
    mpl_figure.set_dpi(DPI)  # resolution of rasterised lines, which an earlier rendering may have changed
    metadata = {"Title": caption(figure.id, figure.title), "Date": None, "Creator": None}
    FigureCanvasSVG(mpl_figure).print_svg(out, metadata=metadata)
    return out.getvalue().encode()


def _render_png(mpl_figure: MplFigure, *, has_image: bool) -> bytes:
    """Render a drawn figure as a PNG file with a palette of 256 colours; `has_image`: True if a panel has an image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image as Picture

    mpl_figure.set_dpi(DPI)
    agg = FigureCanvasAgg(mpl_figure)
    agg.draw()
    out = io.BytesIO()
    with Picture.fromarray(np.asarray(agg.buffer_rgba())[..., :3]) as picture:
        # the median cut spreads the palette evenly over the greys of an image
        method = Picture.Quantize.MEDIANCUT if has_image else Picture.Quantize.FASTOCTREE
        palette_picture = picture.quantize(256, method=method, dither=Picture.Dither.NONE)
        palette_picture.save(out, format="PNG", compress_level=7, dpi=(DPI, DPI))
    return out.getvalue()


def _draw_figure(figure: Figure) -> MplFigure:
    """Lay out and draw a figure: from top to bottom a warning, the shared legend, the panels, and the caption."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as MplFigure

    rows = len(figure.panels)
    has_shared_legend = _has_shared_legend(figure.panels)
    lines = textwrap.wrap(caption(figure.id, figure.title), _CAPTION_CHARACTERS)
    warning = _WARNING_HEIGHT if figure.resolved is False else 0.0
    footer = _LINE_HEIGHT * len(lines) + _CAPTION_MARGIN
    header = _TOP_MARGIN + warning + (_LEGEND_HEIGHT if has_shared_legend else 0.0)
    height = rows * _ROW_HEIGHTS.get(rows, 1.35) + footer + header
    mpl_figure = MplFigure(figsize=(_WIDTH, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(mpl_figure)  # attaches itself to the figure
    engine: Any = mpl_figure.get_layout_engine()
    # rect: left, bottom, width and height of the area of the panels, as fractions of the figure
    engine.set(rect=(0, footer / height, 1, 1 - (footer + header) / height), h_pad=0.05, w_pad=0.06, hspace=0.03)
    axes: list[Axes] = mpl_figure.subplots(rows, squeeze=False)[:, 0].tolist()
    have_same_marks = len({panel.marks for panel in figure.panels}) == 1
    for ax, panel in zip(axes, figure.panels, strict=True):
        # marks that all panels share have texts in the first one only
        _draw_panel(mpl_figure, ax, panel, label_marks=ax is axes[0] or not have_same_marks)
        if not has_shared_legend:
            _add_legend(ax, panel)
    _hide_repeated_x_labels(axes, figure.panels)
    if has_shared_legend:
        handles, labels = axes[0].get_legend_handles_labels()
        anchor = (0.5, 1 - (_TOP_MARGIN + warning) / height)
        _thicken_lines(mpl_figure.legend(handles, labels, loc="upper center", bbox_to_anchor=anchor, ncols=len(labels)))
    # positions of texts are fractions of the figure's width and height
    style: dict[str, Any] = {"va": "bottom", "ha": "left", "fontsize": 8.2, "linespacing": 1.25}
    mpl_figure.text(0.012, 0.06 / height, "\n".join(map(typeset, lines)), **style)
    if figure.resolved is False:
        box = {"boxstyle": "square,pad=0.35", "facecolor": "#fff3c4", "edgecolor": "#8f1d14", "linewidth": 1.6}
        mpl_figure.text(
            0.988, 1 - 0.09 / height, UNRESOLVED.upper(), va="top", ha="right", fontsize=8.5, weight="bold",
            color="#5c0f08", bbox=box,
        )  # fmt: skip
    mpl_figure.draw_without_rendering()  # computes the layout, which then stays the same in every rendering
    mpl_figure.set_layout_engine("none")
    return mpl_figure


def _draw_panel(mpl_figure: MplFigure, ax: Axes, panel: Panel, *, label_marks: bool) -> None:
    """Draw a panel's image, curves, marks and axes into `ax`; `label_marks`: True to write the texts of the marks."""
    if panel.image is not None:
        image = panel.image
        mesh = ax.pcolormesh(image.x, image.y, image.values, cmap="Greys", shading="auto", rasterized=True)
        mpl_figure.colorbar(mesh, ax=ax, label=typeset(image.label), pad=0.01, fraction=0.05)
        ax.grid(False)
    for curve in panel.curves:
        _draw_curve(ax, curve, is_only=len(panel.curves) == 1)
    for x, text in panel.marks:
        ax.axvline(x, color="#1b1f24", linewidth=0.8, dashes=(1.5, 1.5), zorder=4)
        if label_marks:
            ax.annotate(
                typeset(text), (x, 0.98), xycoords=("data", "axes fraction"), xytext=(2.5, 0), rotation=90,
                textcoords="offset points", va="top", ha="left", fontsize=6.8, color="#1b1f24", zorder=5,
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.4},
            )  # fmt: skip
    if panel.log_x:
        ax.set_xscale("log")
        _use_plain_numbers(ax.xaxis)
    if panel.log_y:
        ax.set_yscale("log")
        _use_plain_numbers(ax.yaxis)
    ax.set_xlabel(typeset(panel.x_label), labelpad=2)
    ax.set_ylabel(typeset(panel.y_label), labelpad=3)
    if panel.title:
        ax.set_title(typeset(panel.title), loc="left", pad=4)
    if panel.x_range is not None:
        ax.set_xlim(*panel.x_range)
    elif panel.image is None and all(curve.kind == "line" for curve in panel.curves):
        ax.margins(x=0)  # lines fill the width; points and stems at its ends would be cut off
    ax.tick_params(width=0.6, length=3)


def _use_plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis of fewer than four decades with plain numbers; remove labels of minor ticks on any."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_minor_formatter(NullFormatter())
    low, high = sorted(axis.get_view_interval())
    if low > 0 and high / low < 1e4:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def drawn_points(curve: FigureCurve) -> tuple[np.ndarray, np.ndarray]:
    """Select the points (x, y) of a curve that are drawn: at most `_MAX_POINTS` of a line, with its peaks."""
    return thin_curve(curve.x, curve.y, _MAX_POINTS) if curve.kind == "line" else (curve.x, curve.y)


def _draw_curve(ax: Axes, curve: FigureCurve, *, is_only: bool) -> None:
    """Draw a curve into `ax` in the line style of its role; a panel's only curve is solid if it is a "reference"."""
    style = STYLES["other" if is_only and curve.role == "reference" else curve.role]
    x, y = drawn_points(curve)
    is_dense = x.size > _DENSE_POINTS
    width = min(style.width, 0.6) if is_dense else style.width
    line: dict[str, Any] = {"color": style.colour, "linewidth": width, "label": typeset(curve.label)}
    if style.dashes and not is_dense:
        line["dashes"] = style.dashes
    marker: dict[str, Any] = {"marker": style.marker, "markersize": 4.2, "color": style.colour}
    if style.marker != "x":  # a cross has no face
        marker["markerfacecolor"] = style.colour if style.filled else "white"
    if curve.kind == "points":
        ax.plot(x, y, linestyle="none", label=line["label"], **marker)
    elif curve.kind == "stems":
        ax.vlines(x, 0, y, color=style.colour, linewidth=0.8)
        ax.plot(x, y, linestyle="none", label=line["label"], **{**marker, "markersize": 3})
        ax.axhline(0, color="#444b52", linewidth=0.6)
    else:
        ax.plot(x, y, **line)


def _has_shared_legend(panels: Sequence[Panel]) -> bool:
    """Return True if several panels have the same two or more curves, whose labels fit on one line."""
    keys = {tuple((curve.label, curve.role, curve.kind) for curve in panel.curves) for panel in panels}
    labels = [curve.label for curve in panels[0].curves]
    is_short = sum(map(len, labels)) + _LABEL_MARGIN * len(labels) <= _MAX_SHARED_CHARACTERS
    return len(panels) > 1 and len(keys) == 1 and len(labels) > 1 and is_short


def _add_legend(ax: Axes, panel: Panel) -> None:
    """Add the legend of a panel above the axes, if it has several curves, or one that the y axis does not name.

    A panel's only curve has no legend if the y axis's label contains its label, or if the panel has no title.
    """
    labels = [curve.label for curve in panel.curves]
    if len(labels) > 1 or (labels and panel.title and labels[0] not in panel.y_label):
        legend = ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(labels), borderaxespad=0.1)
        _thicken_lines(legend)


def _thicken_lines(legend: Legend) -> None:
    """Set a minimum width for the lines in a legend, because curves of many points are drawn thin."""
    for line in legend.get_lines():
        line.set_linewidth(max(1.3, line.get_linewidth()))


def _hide_repeated_x_labels(axes: Sequence[Axes], panels: Sequence[Panel]) -> None:
    """Remove the x labels of all panels but the lowest, if all have the same x axis and none an image."""
    x_axes = {(ax.get_xlabel(), tuple(round(end, 9) for end in ax.get_xlim())) for ax in axes}
    if len(x_axes) == 1 and all(panel.image is None for panel in panels):
        for ax in axes[:-1]:
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)
