"""Curves over the one number in which a family of scenes differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from polarguide.experiments.study import LEFT, read_study, study_svg


def results() -> dict[str, Any]:
    table = [
        {"scene": f"views-{n}", "recipe": recipe,
         "cells": {"psnr": {"mean": 20.0 + n * k}, "normal_mae_deg": {"mean": None}}}
        for n in (9, 18, 36)
        for k, recipe in enumerate(("3dgs", "a<b"))
    ]  # fmt: skip
    return {"recipes": [{"name": "3dgs"}, {"name": "a<b"}], "table": table}


def test_a_family_is_drawn() -> None:
    studies = {f"views-{n}": ("views", float(n)) for n in (9, 18, 36)}
    text = study_svg(results(), studies)
    assert text is not None
    root = ElementTree.fromstring(text)
    name = "{http://www.w3.org/2000/svg}"
    assert len(root.findall(f"{name}polyline")) == 2  # nothing is known about normals: one panel
    assert len(root.findall(f"{name}circle")) == 6
    titles = [title.text for title in root.iter(f"{name}title")]
    assert "a<b, views 36: 56.00" in titles
    assert "training views" in [text.text for text in root.iter(f"{name}text")]


def test_the_axis_starts_at_zero_only_where_that_is_near() -> None:
    def left_ends(*values: float) -> list[float]:
        text = study_svg(
            results(), {f"views-{n}": ("index", v) for n, v in zip((9, 18, 36), values, strict=True)}
        )
        assert text is not None
        root = ElementTree.fromstring(text)
        return [float(line.get("points", "").split(",")[0]) for line in root if line.tag.endswith("polyline")]

    assert left_ends(1.3, 1.5, 1.7) == [LEFT, LEFT]
    assert min(left_ends(0.1, 1.5, 1.7)) > LEFT


def test_what_is_no_family_is_not_drawn() -> None:
    assert study_svg(results(), {"views-9": ("views", 9.0), "views-18": None}) is None
    assert study_svg(results(), {"views-9": ("views", 9.0), "views-18": ("noise", 1.0)}) is None
    assert study_svg(results(), {"views-9": ("views", 9.0), "views-18": ("views", 9.0)}) is None


def test_the_number_is_read_from_the_scene(tmp_path: Path) -> None:
    assert read_study(tmp_path) is None
    (tmp_path / "scene.json").write_text(json.dumps({"study": {"parameter": "noise", "value": 2}}))
    assert read_study(tmp_path) == ("noise", 2.0)
    (tmp_path / "scene.json").write_text("{")
    assert read_study(tmp_path) is None
