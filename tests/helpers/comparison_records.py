"""Hand-made records of comparisons, for tests of tables and reports."""

from typing import Any

from polarguide.core.records import decode
from polarguide.results.evaluation.table import COLUMNS
from polarguide_bench.results import FORMAT, Record, Results


def run(scene: str, recipe: str, seed: int, **metrics: float | None) -> dict[str, Any]:
    """Return a finished run with these metrics. All others are null."""
    values = {**dict.fromkeys(c.key for c in COLUMNS), **metrics}
    return {
        "scene": scene,
        "recipe": recipe,
        "seed": seed,
        "folder": f"runs/{scene}/{recipe}/{seed}",
        "state": "done",
        "error": None,
        "metrics": values,
        "lpips_reason": None if values["lpips"] is not None else "no weights",
        "views": {"v0": dict(values)},
        "objects": {},
        "materials": {},
    }


def part(material: str | None = None, **metrics: float | None) -> dict[str, Any]:
    """Return scores of a run on an object or a material."""
    return {"material": material, "pixels": 100, "views": 2, "metrics": metrics}


def unfinished(scene: str, recipe: str, seed: int, error: str | None = None) -> dict[str, Any]:
    """Return a failed run if there is an error, else a missing one."""
    blank = {"metrics": None, "views": {}, "lpips_reason": None, "objects": {}, "materials": {}}
    return run(scene, recipe, seed) | blank | {"state": "failed" if error else "missing", "error": error}


def content(
    runs: list[dict[str, Any]],
    against: str | None = None,
    **provenance: Any,
) -> dict[str, Any]:
    """Return the record of these runs as JSON."""
    scenes, recipes = (list(dict.fromkeys(r[key] for r in runs)) for key in ("scene", "recipe"))
    made = {
        "version": "1",
        "commit": None,
        "sources": "abc",
        "command": "polarguide compare",
        "date": "2026-01-01",
    }
    settings = {"steps": 10, "seeds": len({r["seed"] for r in runs}), "downscale": 1, "transfer": "linear"}
    settings |= {"refractive_index": 1.5, "threads": 1, "jobs": 1, "against": against}
    scene = {"digest": "d" * 64, "views": 3, "test_views": ["v0"]}
    return {
        "format": FORMAT,
        "provenance": {**made, **provenance},
        "settings": {**settings, "background": "auto", "materials": "auto"},
        "scenes": [{"name": name, **scene} for name in scenes],
        "recipes": [{"name": name, "about": f"about {name}", "data": {}} for name in recipes],
        "runs": runs,
    }


def results(runs: list[dict[str, Any]], **more: Any) -> Results:
    """Return a comparison of these runs. Further arguments are those of ``content``."""
    return Results(decode(content(runs, **more), Record, "results.json"))
