"""The report: whole in one file, safe with any name, and within its size."""

import base64
import dataclasses
import hashlib
import itertools
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from browsers import chromium
from comparison_records import part, results, run, unfinished

from polarguide.capture import GroundTruth, Scene
from polarguide.capture.metadata import Material, SceneObject
from polarguide.visualization.pages import data_uri
from polarguide_bench.report import Tile, _ground_truth_tile, chosen_views, embed, report_html
from polarguide_bench.results import Results
from polarguide_bench.tables import sections

FREE = ("r:unpolarized", "r:unpolarized-without-consistency")
EVIL = "</script><img src=x onerror=alert(1)>&\"'"


def pictures(size: tuple[int, int] = (6, 8)) -> dict[str, np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 256, (*size, 3)).astype(np.uint8)
    return {"final": noise, "normal": noise}


def page(name: str = "cup") -> str:
    view, _ = embed(name, name, [Tile(name, pictures(), {"final": name})], 10**6)
    assert view is not None
    curve = pd.DataFrame(
        {"step": [1, 2], "seconds": [0.1, 0.2], "psnr": [20.0, 21.0], "held_out": [np.nan, 20.5]}
    )
    record = results([run(name, name, 0, psnr=30.0), unfinished(name, "b", 0, name)], command=name)
    return report_html(record, [view], {name: {name: curve}}, [name])


@pytest.mark.parametrize("found", [True, False])
def test_metalness_can_be_chosen_where_a_run_has_found_metal(found: bool) -> None:
    shown = {**pictures(), "metalness": pictures()["final"]}
    tiles = [Tile("truth", shown, {}), Tile("r", shown if found else pictures(), {})]
    view, _ = embed("cup", "v0", tiles, 10**6)
    assert view is not None
    reader = Reader()
    reader.feed(report_html(results([run("cup", "r", 0, psnr=30.0)]), [view], {}))
    layers = next(json.loads(text) for text in reader.scripts if text.startswith('{"final"'))
    assert ("metalness" in layers) is found
    assert list(layers)[:2] == ["final", "diffuse"]


def test_the_truth_of_metalness_is_that_of_the_objects(tiny_scene: Scene) -> None:
    view = tiny_scene.views[0]
    ids = torch.zeros(view.invalid.shape, dtype=torch.int32)
    ids[:4], ids[4:8], ids[8:12] = 1, 2, 3
    kinds = ("metal", "plastic", "roughconductor")
    objects = tuple(SceneObject(k + 1, kind, True, Material(kind)) for k, kind in enumerate(kinds))
    view = dataclasses.replace(view, truth=GroundTruth(object_ids=ids))
    tile = _ground_truth_tile(dataclasses.replace(tiny_scene, objects=objects), view)
    shown = tile.pictures["metalness"].astype(int).sum(axis=2)
    assert bool((shown[:4] > 600).all())
    assert bool((shown[8:12] > 600).all())
    assert bool((shown[4:8] < 20).all())
    assert "metalness" not in _ground_truth_tile(tiny_scene, view).pictures, "no object is known to be metal"


class Reader(HTMLParser):
    """Collects tags, attributes and the text of scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.scripts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1] == "script":
            self.scripts.append(data)


def test_names_and_texts_are_escaped() -> None:
    plain, evil = Reader(), Reader()
    plain.feed(page())
    evil.feed(page(EVIL))
    assert evil.tags == plain.tags, "a name has become markup"
    assert not any(key.startswith("on") for key, _ in evil.attributes)
    assert EVIL not in page(EVIL)
    data = json.loads(next(text for text in evil.scripts if text.startswith("[")))
    assert data[0]["scene"] == data[0]["tiles"][0][0] == EVIL


def test_nothing_comes_from_outside() -> None:
    text = page()
    assert not re.search(r"(?:https?:)?//[a-z]|@import|url\(", text, re.IGNORECASE)
    reader = Reader()
    reader.feed(text)
    assert not {"link", "iframe", "object", "base"} & set(reader.tags)
    sources = [value for key, value in reader.attributes if key in ("src", "href", "action")]
    assert all(source.startswith("data:image/") for source in sources)


def bench() -> Results:
    """Return a comparison with controls, objects, unequal seeds and missing runs."""
    rng = np.random.default_rng(0)
    runs = []
    levels = {
        "3dgs": (30.0, 25.0),
        "3dgs-dr": (30.2, 15.0),
        "r": (31.0, 6.0),
        FREE[0]: (30.8, 9.0),
        FREE[1]: (31.1, 14.0),
    }
    for scene, (recipe, (psnr, angle)) in itertools.product(("figure", "kit", "ceramic"), levels.items()):
        for seed in range(3 if recipe in ("r", FREE[0]) else 1):
            views = {
                f"v{k}": {"psnr": psnr + k + rng.normal(0, 0.2), "normal_mae_deg": angle + rng.normal(0, 0.3)}
                for k in range(4)
            }
            parts = {
                f"{scene} ball": part("metal", psnr=psnr - 3, normal_mae_deg=angle + 5),
                f"{scene} vase": part(
                    "plastic", psnr=psnr + 1 + rng.normal(0, 0.1), normal_mae_deg=angle - 1
                ),
            }
            means = {
                key: float(np.mean([view[key] for view in views.values()]))
                for key in ("psnr", "normal_mae_deg")
            }
            made = run(scene, recipe, seed, **means, gaussians=1000)
            materials = {scores["material"]: scores for scores in parts.values()}
            runs.append(made | {"views": views, "objects": parts, "materials": materials})
    runs[-1] = unfinished("ceramic", FREE[1], 0, "disk full")
    return results(runs, against="3dgs-dr")


def test_every_section_is_on_the_page_and_in_the_browser(tmp_path: Path) -> None:
    record = bench()
    sheets = {"figure": [("r", "runs/figure/r/0-ab cd/errors.png")]}
    path = tmp_path / "report.html"
    path.write_text(report_html(record, [], {"figure": {}}, [], sheets), encoding="utf-8")
    with chromium() as browser:
        view = browser.new_page(viewport={"width": 1500, "height": 1000})
        faults: list[str] = []
        view.on("pageerror", lambda error: faults.append(str(error)))
        view.goto(path.as_uri())
        titles = view.locator("h2:visible").all_inner_texts()
        assert titles[:6] == [
            "Scores on held-out views",
            "Gain by polarization",
            "Differences to 3dgs-dr",
            "By object",
            "By material",
            "Error maps",
        ]
        for section in sections(record):
            rows = view.locator(f"#{section.key} tbody tr")
            assert rows.count() == sum(len(rows) for _, rows in section.blocks)
            wide = view.locator(f"#{section.key}").evaluate("e => e.scrollWidth <= e.clientWidth + 1")
            assert wide, f"{section.key} runs out of its panel"
        assert view.locator("#sheets a").get_attribute("href") == "runs/figure/r/0-ab%20cd/errors.png"
        buys = view.locator("#controls tbody tr").last.inner_text()
        assert "over scenes" in buys
        assert "3 scenes" in buys
        assert "failed" in view.locator("#scores tbody").nth(2).inner_text()
        assert not faults


def test_the_page_says_what_it_holds() -> None:
    text = page()
    assert "$" not in re.sub(r"(?s)<script.*?</script>", "", text), "a place that was not filled"
    for words in ("cup, b, seed 0 failed: cup", "PSNR over steps and seconds", "<td>30.00</td>"):
        assert words in text


def test_a_report_without_pictures_hides_their_section() -> None:
    text = report_html(results([run("cup", "a", 0, psnr=30.0)]), [], {"cup": {}})
    assert '<section id="pictures" hidden>' in text


def test_normals_are_lossless_and_photographs_are_not() -> None:
    picture = pictures()["final"]
    for layer, kind in (("normal", "png"), ("final", "jpeg")):
        head, data = data_uri(picture, layer, 100).split(",")
        assert head == f"data:image/{kind};base64"
        decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(decoded[..., ::-1], picture) is (layer == "normal")


def test_pictures_shrink_until_they_fit_and_are_left_out_if_nothing_helps() -> None:
    tiles = [Tile("a", pictures((300, 400)), {})]
    whole, note = embed("s", "v", tiles, 10**7)
    assert note is None
    size = sum(map(len, whole.tiles[0][1].values()))
    less, note = embed("s", "v", tiles, size // 2)
    assert (less.width, less.height) == (400, 300)
    assert sum(map(len, less.tiles[0][1].values())) <= size // 2
    assert note == "s, v: pictures reduced from 400 to 200 pixels."
    none, note = embed("s", "v", tiles, 1000)
    assert none is None
    assert "left out" in str(note)


def test_chosen_views_are_spread() -> None:
    assert chosen_views("abc", 5) == ["a", "b", "c"]
    assert chosen_views("abcdef", 3) == ["a", "c", "e"]
    assert chosen_views("abc", 0) == []


def test_no_script_but_its_own_may_run() -> None:
    text = report_html(results([run("cup", "a", 0, psnr=30.0)]), [], {"cup": {}})
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; script-src 'sha256-{digest}';")
    assert " onclick=" not in text.replace(script, "")
