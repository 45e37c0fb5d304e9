"""What polarization buys, and differences to a recipe that was asked for: tables of paired differences."""

from __future__ import annotations

from collections.abc import Sequence

from polarguide.evaluation.table import Metric
from polarguide.experiments.controls import controlled
from polarguide.experiments.differences import COMPARED, Difference
from polarguide.experiments.results import Results
from polarguide.experiments.shown import Block, Label, Row, Section, ShownCell, signed

OVER_SCENES = "over scenes"
_HOW = (
    "Differences are taken at the same seed and test view. Bold: better, beyond noise; ≈: within noise, another seed, "
    "other views or, over scenes, other scenes may turn it; ?: noise not known.",
    "Brackets: 95 % confidence interval by Student's t, over scenes or seeds where these are at least three, else over "
    "test views: that one holds for these trainings only, and what is noise is judged by the known scatter, too.",
)


def control_section(results: Results) -> Section | None:
    """A block for every recipe with controls, a row for every scene; None without such a recipe."""
    recipes = controlled([recipe["name"] for recipe in results["recipes"]])
    found = [d for d in results["differences"] if d["why"] == "control"]
    columns = _columns(found)
    blocks, said = [], []
    for recipe, controls in recipes.items():
        letters = dict(zip(controls, "abcdefghij", strict=False)) if len(controls) > 1 else {}
        names = ", ".join(f"{letters[c]}: {c}" if c in letters else c for c in controls)
        mine = [d for d in found if d["recipe"] == recipe]
        rows = [
            _row(scene, [d for d in mine if d["scene"] == scene], columns, letters)
            for scene in _places(results)
        ]
        blocks.append(Block(recipe, tuple(rows)))
        said.append(
            f"{recipe}: the difference to the better of its controls, metric by metric ({names})"
            if letters
            else f"{recipe}: the difference to its control, {names}"
        )
    if not blocks:
        return None
    left_out = dict.fromkeys(
        f"{d['scene'] or OVER_SCENES}, {d['recipe']}: chosen without {', '.join(d['left_out'])}, for want of "
        "runs to pair"
        for d in found
        if d["left_out"]
    )
    return Section(
        "controls",
        "What polarization buys",
        ("scene", "interval over"),
        tuple(column.heading for column in columns),
        tuple(blocks),
        (*(f"{text}." for text in (*said, *left_out)), *_HOW),
    )


def against_section(results: Results) -> Section | None:
    """A block for every scene, a row for every other recipe; None where no recipe to compare with was asked for."""
    against = results["settings"]["against"]
    if against is None:
        return None
    found = [d for d in results["differences"] if d["why"] == "against"]
    columns = _columns(found)
    blocks = []
    for scene in _places(results):
        rows = []
        for recipe in (r["name"] for r in results["recipes"] if r["name"] != against):
            mine = [d for d in found if d["scene"] == scene and d["recipe"] == recipe]
            rows.append(_row(recipe, mine, columns, {}, code=True))
        blocks.append(Block(scene or OVER_SCENES, tuple(rows)))
    headings = tuple(column.heading for column in columns)
    title = f"Differences to {against}"
    return Section("against", title, ("recipe", "interval over"), headings, tuple(blocks), _HOW)


def _places(results: Results) -> list[str | None]:
    names: list[str | None] = [scene["name"] for scene in results["scenes"]]
    return [*names, None] if len(names) > 1 else names


def _columns(found: Sequence[Difference]) -> list[Metric]:
    return [
        column
        for column in COMPARED
        if column.shown == "tables" and any(d["metric"] == column.key for d in found)
    ]


def _row(
    name: str | None,
    found: Sequence[Difference],
    columns: Sequence[Metric],
    letters: dict[str, str],
    *,
    code: bool = False,
) -> Row:
    """The differences of one row; what most of its intervals are over is said once, the others in their cells."""
    by_key = {difference["metric"]: difference for difference in found}
    shown = [by_key[column.key] for column in columns if column.key in by_key]
    units = [_unit(difference) for difference in shown]
    usual = max(dict.fromkeys(units), key=units.count, default="")
    cells = []
    for column in columns:
        difference = by_key.get(column.key)
        if difference is None:
            cells.append(ShownCell())
            continue
        unit = _unit(difference)
        other = f"({unit})" if unit != usual else ""
        cells.append(_cell(difference, column, other, letters.get(difference["other"], "")))
    remark = "" if found else "no runs to pair"
    return Row((Label(name or OVER_SCENES, code, remark), Label(usual)), tuple(cells))


def _unit(difference: Difference) -> str:
    """What the interval is over; without one, the number of seeds."""
    if difference["over"] is None:
        return f"none, {difference['seeds']} seed{'' if difference['seeds'] == 1 else 's'}"
    seeds = difference["seeds"]
    beside = f" of {seeds} seed{'' if seeds == 1 else 's'}" if difference["over"] == "views" else ""
    return f"{difference['count']} {difference['over']}{beside}"


def _cell(difference: Difference, column: Metric, *more: str) -> ShownCell:
    better = (difference["mean"] > 0) == (column.better == "higher")
    value = difference_text(difference["mean"], difference["noise"], column)
    low, high = difference["low"], difference["high"]
    interval = "" if low is None or high is None else f"[{signed(low, column)}, {signed(high, column)}]"
    rest = " ".join(filter(None, (interval, *more)))
    return ShownCell(value, rest, difference["noise"] is False and better)


def difference_text(value: float, noise: bool | None, column: Metric) -> str:
    """A difference with the mark of its noise: ≈ within it, ? not known."""
    return {True: "≈ ", False: "", None: ""}[noise] + signed(value, column) + ("?" if noise is None else "")
