"""Convert recordings to and from pandas data frames and xarray data sets, named and described as in the files."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import LONG_NAMES, Array
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_attributes, stated_rate
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.netcdf import make_attributes
from sealscope.recordings.formats.table import FORMAT_VERSION, RecordingFields, Series, build_fields, parse_description

if TYPE_CHECKING:
    import pandas
    import xarray


def to_pandas(
    values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> pandas.DataFrame:
    """Make a data frame of the content of `Recording.series`, with the index `t [s]` and columns such as `p_A [Pa]`.

    Its `attrs` contain the units by column, the rate, the provenance and the history.
    """
    pandas = import_library("pandas", "a data frame", "pandas")
    columns = {f"{name} [{units[name]}]": series.copy() for name, series in values.items() if name != "t"}
    frame = pandas.DataFrame(columns, index=pandas.Index(values["t"].copy(), name="t [s]"))
    metadata = {key: description[key] for key in ("rate", "provenance", "history")}
    frame.attrs = {"units": {f"{name} [{unit}]": unit for name, unit in units.items()}, **metadata}
    return frame  # type: ignore[no-any-return]


def read_pandas(frame: pandas.DataFrame, request: Request) -> RecordingFields:
    """Read the requested columns of a data frame to the fields of a recording.

    An index with a name is also read as a column. An index of dates, time differences or floating-point numbers may
    lack a name, and is then called `t`. The unit of a column is in the `attrs` of the frame or of the column, or else
    in its name. Raises InputError if `frame` is not a data frame.
    """
    pandas = import_library("pandas", "a data frame", "pandas")
    if not isinstance(frame, pandas.DataFrame):
        raise InputError(f"frame must be a pandas.DataFrame, got a {type(frame).__name__}")
    columns = [(str(name), frame.iloc[:, i]) for i, name in enumerate(frame.columns)]
    index = frame.index
    # floats, time differences, dates; integers without a name only number the rows
    if index.name is not None or index.dtype.kind in "fmM":
        columns.append(("t" if index.name is None else str(index.name), index.to_series()))
    units = frame.attrs.get("units")
    units = units if isinstance(units, Mapping) else {}
    series = []
    for name, column in columns:
        unit = units.get(name, column.attrs.get("units"))
        default_unit = "s" if pandas.api.types.is_timedelta64_dtype(column.dtype) else None
        label = Label.parse(name, unit if isinstance(unit, str) else default_unit)
        read_values = partial(_convert_column, pandas.api.types, column, name)
        series.append(Series(group="", label=label, count=len(frame), values=read_values))
    try:
        description = parse_description({"format": FORMAT_VERSION, **frame.attrs})  # `to_pandas` writes no "format"
    except InputError:  # not written by `to_pandas`
        description = None
    remarks = collect_attributes(frame.attrs)
    return build_fields(series, request, "pandas", remarks, stated_rate(remarks), description=description)


def _convert_column(dtypes: Any, series: Any, name: str) -> NDArray[Any]:
    """Convert a pandas series, with `dtypes` = pandas.api.types, to datetime64, timedelta64, doubles or texts (n,).

    Dates with a time zone are converted to UTC, and missing texts become empty. Raises InputError, which calls the
    series `name`, for other types such as complex numbers.
    """
    if dtypes.is_datetime64_any_dtype(series.dtype):
        if getattr(series.dtype, "tz", None) is not None:
            series = series.dt.tz_convert("UTC").dt.tz_localize(None)
        return np.asarray(series.to_numpy().astype("datetime64[ns]"))
    if dtypes.is_timedelta64_dtype(series.dtype):
        return np.asarray(series.to_numpy())
    if dtypes.is_numeric_dtype(series.dtype) and not dtypes.is_complex_dtype(series.dtype):
        return np.asarray(series.to_numpy(dtype=np.float64, na_value=np.nan))
    if dtypes.is_string_dtype(series.dtype) or dtypes.is_object_dtype(series.dtype):
        cells = ["" if missing else str(cell) for cell, missing in zip(series, series.isna(), strict=True)]
        return np.array(cells, dtype=object)
    raise InputError(f"{name} must hold numbers, got the type {series.dtype}")


def to_xarray(values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]) -> xarray.Dataset:
    """Make a data set of the content of `Recording.series`, named and described as in NetCDF files."""
    xarray = import_library("xarray", "a data set", "xarray")
    variables = {
        name: ("t", series.copy(), {"units": units[name], "long_name": LONG_NAMES.get(name, name)})
        for name, series in values.items()
    }
    time = {"t": variables.pop("t")}
    return xarray.Dataset(variables, coords=time, attrs=make_attributes(description))
