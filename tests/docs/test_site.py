"""The site: its workflow, files of other hosts, and the gallery's table and sliders."""

import io
import json
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from browsers import chromium
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "docs" / "_static" / "scenes"
sys.path += [str(ROOT / "docs" / "_extensions"), str(ROOT / "benchmarks" / "front")]
import gallery  # noqa: E402
from offline import requests_elsewhere  # noqa: E402

GALLERY = msgspec.json.decode((gallery.HERE / "gallery.json").read_bytes(), type=gallery.Gallery)


def test_the_workflow_builds_the_site_and_publishes_it_only_from_the_default_branch():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "site.yml").read_text())
    assert workflow[True] == {
        "push": {"branches": ["main"]},
        "workflow_dispatch": None,
    }  # YAML reads "on" as True.
    assert workflow["permissions"] == {"contents": "read"}
    build = workflow["jobs"]["build"]
    steps = {step.get("uses", step.get("run", "")).split("@")[0]: step for step in build["steps"]}
    assert "make site" in steps
    assert "\nsite: docs\n" in (ROOT / "Makefile").read_text()
    assert steps["actions/upload-pages-artifact"]["with"] == {"path": "build/docs"}
    assert "actions/configure-pages" in steps
    publish = workflow["jobs"]["publish"]
    assert publish["needs"] == "build"
    assert publish["permissions"] == {"pages": "write", "id-token": "write"}
    assert [step["uses"].split("@")[0] for step in publish["steps"]] == ["actions/deploy-pages"]


def test_committed_pages_styles_and_scripts_load_no_file_of_another_host():
    assert len([*SCENES.glob("*.html")]) == len(GALLERY.scenes) + 1
    assert [*requests_elsewhere(ROOT / "docs" / "_static")] == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", '<script src="https://cdn.test/a.js"></script>'),
        ("a.html", "<img src=//cdn.test/a.png>"),
        ("a.html", '<img srcset="a.png 1x, https://cdn.test/a.png 2x">'),
        ("a.html", '<video poster="http://cdn.test/a.png"></video>'),
        ("a.html", '<link rel="stylesheet" href="https://cdn.test/a.css">'),
        ("a.html", '<link rel="shortcut icon" href="https://cdn.test/a.ico">'),
        ("a.html", '<p style="background: url(https://cdn.test/a.png)">'),
        ("a.html", "<style>@import 'https://cdn.test/a.css';</style>"),
        ("a.html", "<script>fetch('https://cdn.test/a.json')</script>"),
        ("a.css", '@import "//cdn.test/a.css";'),
        ("a.css", "@font-face { src: url( 'https://cdn.test/a.woff2' ) }"),
        ("a.js", 'import("https://cdn.test/a.js")'),
        ("a.js", 'import { a } from "https://cdn.test/a.js"'),
        ("a.js", "new WebSocket(`wss://cdn.test`)"),
        ("a.js", 'request.open("GET", "https://cdn.test/a")'),
        ("a.html", '<base href="https://cdn.test/">'),
        ("a.svg", '<use href="https://cdn.test/a.svg#a"/>'),
        ("a.svg", '<image xlink:href="https://cdn.test/a.png"/>'),
    ],
)
def test_a_file_of_another_host_is_found(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    (line,) = requests_elsewhere(tmp_path)
    assert line.startswith(f"{name}: ")
    assert "cdn.test" in line


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", '<a href="https://other.test">a link</a>'),
        ("a.html", '<link rel="canonical" href="https://other.test">'),
        ("a.html", '<img src="data:image/png;base64,//8A"><img src="a.png">'),
        ("a.html", "<p>fetch('https://other.test')</p>"),
        ("a.css", "/* https://other.test */ @import 'a.css'; p { background: url(a.png) }"),
        ("a.js", "// https://other.test\nfetch('a.json')"),
    ],
)
def test_links_and_own_files_are_fine(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert [*requests_elsewhere(tmp_path)] == []


def test_the_gallery_shows_the_recorded_scores_of_its_pages():
    record = json.loads(gallery.RECORD.read_text())
    page = (ROOT / "docs" / "gallery.md").read_text()
    assert list(record) == [scene.name for scene in GALLERY.scenes]
    for scene in GALLERY.scenes:
        assert gallery.table_row(scene, record[scene.name]) in page
        assert record[scene.name]["bytes"] == (SCENES / f"{scene.name}.html").stat().st_size
        for file in (f"{scene.name}.html", f"{scene.name}.jpg", f"{scene.name}-layers.jpg"):
            assert f'="_static/scenes/{file}"' in page
        assert page.count(f'alt="{scene.about}"') == 1


def test_the_gallery_is_small():
    files = {path.name: path.stat().st_size for path in SCENES.iterdir()}
    assert max(size for name, size in files.items() if name.endswith(".html")) < 3e6
    assert sum(size for name, size in files.items() if not name.endswith(".html")) < 2e6
    assert sum(files.values()) < 16e6


def test_columns_and_rows_of_the_sheets_are_those_of_the_slider():
    script = (ROOT / "docs" / "_static" / "wipes.js").read_text()
    columns, layers = (
        json.loads(script.partition(f"const {name} = ")[2].partition(";")[0])
        for name in ("COLUMNS", "LAYERS")
    )
    assert len(columns) == 1 + len(gallery.RECIPES)
    assert len(layers) == len(gallery.ROWS)
    assert columns[1] == gallery.RECIPES[0]


def test_a_slider_shows_the_chosen_pictures_of_a_sheet(tmp_path):
    column, row = np.meshgrid(range(4), range(3))
    colors = np.stack((60 * column, 80 * row, 0 * row), axis=-1).astype(np.uint8)
    Image.fromarray(np.repeat(np.repeat(colors, 96, axis=0), 128, axis=1)).save(tmp_path / "sheet.png")
    static = (ROOT / "docs" / "_static").as_uri()
    (tmp_path / "page.html").write_text(
        f'<!doctype html><link rel="stylesheet" href="{static}/polarguide.css">'
        f'<script src="{static}/wipes.js" defer></script><img class="wipe" src="sheet.png" alt="a sheet">'
    )

    def sides():
        shot = Image.open(io.BytesIO(page.locator(".pictures").screenshot())).convert("RGB")
        return [
            shot.getpixel((round(place * shot.width), shot.height // 2)) for place in (0.1, 0.4, 0.6, 0.9)
        ]

    with chromium() as browser:
        page = browser.new_page()
        page.goto((tmp_path / "page.html").as_uri())
        assert sides() == [(0, 0, 0), (0, 0, 0), (180, 0, 0), (180, 0, 0)]
        columns, layers = page.locator("select").all()
        columns.select_option("ours without polarization")
        layers.select_option("normals")
        assert sides() == [(120, 160, 0), (120, 160, 0), (180, 160, 0), (180, 160, 0)]
        page.get_by_role("slider").fill("75")
        assert sides() == [(120, 160, 0)] * 3 + [(180, 160, 0)]
