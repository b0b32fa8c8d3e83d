"""Where items are made: the Context handed to the makers, noting what each of them asked for."""

from __future__ import annotations

import hashlib
import importlib
import json
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.errors import InputError, SealscopeError
from sealscope.thesis.engine.context import RunSpec, SimulatedRun
from sealscope.thesis.engine.items import Entry, Item
from sealscope.thesis.engine.products import Claim, Curve, Figure, Product, Table, thinned
from sealscope.thesis.engine.sources import LIBRARIES, sources_key
from sealscope.thesis.engine.store import Record, Store
from sealscope.thesis.sheet import MISSING, Sheet, read_sheet

if TYPE_CHECKING:
    from sealscope.recordings.recording import Array

#: Draws an item's products into a folder and returns its files, relative to the folder.
Publish = Callable[[Item, tuple[Product | Claim, ...], Path], tuple[str, ...]]
LEFT_OUT = "left out"
_DRAWING = ("matplotlib", "pillow", "jinja2")
_RUNS = "sealscope.thesis.engine.runs"


@dataclass(frozen=True)
class Job:
    """One reproduction, as a worker process gets it."""

    folder: Path
    registry: tuple[Item, ...]
    quick: bool = False
    sheet: Path | None = None
    publish: Publish | None = None


class Bench:
    """Makes and draws one item after the other, and says which need it."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.store = Store(job.folder)
        self.items = {item.id: item for item in job.registry}
        self.sheet: Sheet | None = None
        self.sheet_key = "none"
        if job.sheet is not None:
            self.sheet, self.sheet_key = read_sheet(job.sheet)
        self._runs: dict[str, SimulatedRun] = {}

    def left_out(self, item: Item) -> str:
        """Why an item cannot be made in this call; empty where it can."""
        return MISSING if item.needs_sheet and self.sheet is None else ""

    def key(self, item: Item) -> str:
        """Hash of all that an item's products rest on beside the sheet, the runs and other items."""
        module = _module(item.make)
        text = json.dumps([astuple(item), self.job.quick, sources_key(module, LIBRARIES)], default=str)
        return hashlib.sha256(text.encode()).hexdigest()

    def stamp(self, name: str) -> str:
        """The stamp of an item's kept product where it is still good, else an empty text."""
        item = self.items.get(name)
        if item is None:
            return ""
        if self.left_out(item):
            return LEFT_OUT
        record = self.store.record(name, self.job.quick)
        good = (
            record is not None
            and record.key == self.key(item)
            and record.sheet in (None, self.sheet_key)
            and record.runs in (None, sources_key(_RUNS, LIBRARIES))
            and all(self.stamp(other) == stamp for other, stamp in record.asked.items())
        )
        return record.stamp() if record is not None and good else ""

    def drawing(self, stamp: str) -> str:
        """Key of the drawing of a product: the product and all that draws it."""
        publish = self.job.publish
        return f"{stamp} {sources_key(publish.__module__, _DRAWING)}" if publish is not None else stamp

    def entry(self, item: Item) -> Entry:
        """What stands in the folder of an item: kept, left out or not made."""
        if reason := self.left_out(item):
            return Entry(item, "left out", reason)
        stamp = self.stamp(item.id)
        drawn, files = self.store.drawn(item.id)
        if stamp and drawn == self.drawing(stamp):
            return Entry(item, "kept", files=files)
        return Entry(item, "not made")

    def work(self, name: str) -> Entry:
        """Make an item, or only draw it, where its kept product is good; a failure is told in the entry."""
        item = self.items[name]
        began = time.perf_counter()
        try:
            there = self.entry(item)
            if there.state == "kept":
                return there
            stamp = self.stamp(name)
            products = self.store.products(name, self.job.quick) if stamp else None
            made = products is None
            if products is None:
                products = self._make(item)
                stamp = self.stamp(name)
            files = () if self.job.publish is None else self.job.publish(item, products, self.job.folder)
            self.store.keep_drawn(name, self.drawing(stamp), files)
        except Exception as error:
            self.store.failed(name, traceback.format_exc())
            words = str(error) if isinstance(error, SealscopeError) else f"{type(error).__name__}: {error}"
            first = words.strip().splitlines()[0] if words.strip() else type(error).__name__
            return Entry(item, "failed", first, time.perf_counter() - began)
        return Entry(item, "made" if made else "drawn", "", time.perf_counter() - began, files)

    def _make(self, item: Item) -> tuple[Product | Claim, ...]:
        began = time.perf_counter()
        context = BenchContext(self, item)
        function = getattr(importlib.import_module(_module(item.make)), item.make.split(":")[1])
        products = tuple(_lean(product) for product in function(context, item))
        for product in products:
            if not isinstance(product, (Figure, Table, Claim)):
                raise TypeError(f"a maker must give Figure, Table or Claim, got {type(product).__name__}")
        record = Record(
            key=self.key(item),
            sheet=self.sheet_key if context.saw_sheet else None,
            runs=sources_key(_RUNS, LIBRARIES) if context.ran else None,
            asked=dict(context.asked),
            seconds=round(time.perf_counter() - began, 3),
        )
        self.store.keep(item.id, self.job.quick, record, products)
        return products

    def run(self, spec: RunSpec) -> SimulatedRun:
        """The run of `spec`: from memory, from the folder, or simulated now."""
        from sealscope.thesis.engine.runs import experiment_of, simulated

        experiment = experiment_of(spec)
        text = f"{experiment.key()} {spec.prove} {sources_key(_RUNS, LIBRARIES)}"
        key = hashlib.sha256(text.encode()).hexdigest()[:32]
        if key not in self._runs:
            found = self.store.run(key, lambda: simulated(spec, experiment))
            while len(self._runs) >= 2:
                del self._runs[next(iter(self._runs))]
            self._runs[key] = found
        return self._runs[key]


class BenchContext:
    """The Context of one item's maker; notes what it used, for the item's record."""

    def __init__(self, bench: Bench, item: Item) -> None:
        self._bench, self._item = bench, item
        self.quick = bench.job.quick
        self.saw_sheet = item.needs_sheet
        self.ran = False
        self.asked: dict[str, str] = {}

    @property
    def sheet(self) -> Sheet | None:
        """The measured sheet, None where nobody gave it."""
        self.saw_sheet = True
        return self._bench.sheet

    def run(self, spec: RunSpec) -> SimulatedRun:
        """The run of `spec`, simulated now or earlier."""
        self.ran = True
        return self._bench.run(spec)

    def product(self, item: str) -> tuple[Product | Claim, ...]:
        """What an item among the maker's `needs` gives; () where that one is left out for want of the sheet."""
        if item not in self._item.needs:
            raise InputError(f"{self._item.id} must name {item} among its needs to ask for its products")
        bench = self._bench
        stamp = bench.stamp(item)
        self.asked[item] = stamp
        if stamp == LEFT_OUT:
            return ()
        found = bench.store.products(item, bench.job.quick) if stamp else None
        if found is None:
            raise InputError(f"{self._item.id} needs {item}, which could not be made")
        return found


def _module(make: str) -> str:
    """The module of a maker."""
    return make.split(":", maxsplit=1)[0]


def _lean(product: Any) -> Any:
    """A figure with long lines thinned to what an eye can see."""
    if not isinstance(product, Figure):
        return product
    panels = tuple(replace(panel, curves=tuple(map(_thin, panel.curves))) for panel in product.panels)
    return replace(product, panels=panels)


def _thin(curve: Curve) -> Curve:
    if curve.kind != "line":
        return curve
    pair: Sequence[Array] = thinned(curve.x, curve.y)
    return replace(curve, x=pair[0], y=pair[1])
