"""Pages and texts of diagnoses, campaigns and the reproduced thesis (names only, loaded when first used)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope.reporting.charts import Mark
    from sealscope.reporting.index import write_index
    from sealscope.reporting.messages import diagnosis_text, short_text
    from sealscope.reporting.overview import overview_text
    from sealscope.reporting.page import render_page, write_page

__all__ = ["Mark", "diagnosis_text", "overview_text", "render_page", "short_text", "write_index", "write_page"]

_HOMES = {
    "Mark": "charts",
    "diagnosis_text": "messages",
    "overview_text": "overview",
    "render_page": "page",
    "short_text": "messages",
    "write_index": "index",
    "write_page": "page",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"sealscope.reporting.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
