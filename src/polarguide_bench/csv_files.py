"""Tables of scores as CSV files."""

from __future__ import annotations

import pandas as pd

from polarguide.core.text import csv_value
from polarguide.results.evaluation.table import METAL_SHARE, METRICS


def csv_text(frame: pd.DataFrame) -> str:
    """A frame in full precision, with the numbers that pages show; nothing in it is a formula to a spreadsheet."""
    return in_shown_units(frame).map(csv_value).to_csv(index=False, lineterminator="\n")


def in_shown_units(frame: pd.DataFrame) -> pd.DataFrame:
    """A frame whose metrics have the unit of tables, where records have another: shares are in percent.

    Args:
        frame: metrics are columns by their keys, with their ``_spread``; or lines, of which ``metric`` has the key.

    Returns:
        Keys of those metrics end with the unit: ``haze_percent``.
    """
    scaled = {metric.key: metric for metric in (*METRICS, METAL_SHARE) if metric.factor != 1}
    names = {
        key: f"{key}_{'percent' if metric.unit == '%' else metric.unit}" for key, metric in scaled.items()
    }
    frame = frame.copy()
    for column in frame.columns:
        metric = scaled.get(column.removesuffix("_spread"))
        if metric is not None:
            frame[column] = frame[column].astype(float) * metric.factor
    if "metric" in frame:
        factors = [scaled[key].factor if key in scaled else 1.0 for key in frame["metric"]]
        for column in ("mean", "low", "high"):
            frame[column] = frame[column] * factors
        frame["metric"] = frame["metric"].replace(names)
    spreads = {f"{key}_spread": f"{name}_spread" for key, name in names.items()}
    return frame.rename(columns=names | spreads)
