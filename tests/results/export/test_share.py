"""The page: whole in one file, safe with any name, and small."""

import base64
import gzip
import hashlib
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from random_runs import KINDS, random_state, ring

from polarguide.capture.presentation import Presentation
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.results.export import web_page
from polarguide.results.export.adapters import page_shading
from polarguide.results.export.web_page import BAKED, baked_page, harmonics_steps, records, share_page
from polarguide.runs.model import gaussian_colors
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.model import PLAIN, Light, Parameters
from polarguide.shading.result import RenderResult

REFLECTING = ["final", "diffuse", "specular", "base", "strength", "normal"]
LAYERS = {
    "plain": ["final", "normal"],
    "reflection": REFLECTING,
    "local": [
        "final",
        "diffuse",
        "specular",
        "strength",
        "normal",
        "roughness",
    ],  # its base is the diffuse layer
    "directional": ["final", "diffuse", "specular", "base", "normal"],
}
TEXELS = {"plain": 6, "reflection": 6, "local": 10, "directional": 4}
EVIL = "</script><img src=x onerror=alert(1)>&\"'${0}$title"


def page(recipe: str = "3dgs-dr", name: str = "cup") -> str:
    state, shading = random_state(recipe)
    cameras = {f"{name}{key}": camera for key, camera in ring().items()}
    return share_page(
        state.gaussians,
        state.light,
        shading,
        cameras,
        first=f"{name}v1",
        title=name,
        caption=name,
        metrics=[(name, name)],
    )


class Reader(HTMLParser):
    """Collects tags, attributes and the scripts by their id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.scripts: dict[str, str] = {}
        self._script = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        self._script = dict(attrs).get("id") or "program" if tag == "script" else ""

    def handle_endtag(self, tag: str) -> None:
        self._script = ""

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data


def test_names_and_captions_are_escaped() -> None:
    plain, evil = Reader(page()), Reader(page(name=EVIL))
    assert evil.tags == plain.tags, "a name has become markup"
    assert not any(key.startswith("on") for key, _ in evil.attributes)
    assert EVIL not in page(name=EVIL)
    scene = json.loads(evil.scripts["scene"])
    assert scene["cameras"][0]["name"] == f"{EVIL}v0"
    assert scene["first"] == 1


def test_nothing_comes_from_outside_and_only_the_page_s_own_script_may_run() -> None:
    text = page()
    assert not re.search(r"(?:https?:)//[a-z]|@import|(?<![a-z])url\(", text, re.IGNORECASE)
    reader = Reader(text)
    assert not {"link", "iframe", "object", "base", "img"} & set(reader.tags)
    assert not [value for key, value in reader.attributes if key in ("src", "href", "action")]
    policy = next(str(value) for key, value in reader.attributes if "default-src" in str(value))
    digest = base64.b64encode(hashlib.sha256(reader.scripts["program"].encode()).digest()).decode()
    assert "default-src 'none'" in policy
    assert f"script-src 'sha256-{digest}' blob:" in policy
    rest = re.sub(r"(?s)<script.*?</script>", "", text)
    assert not re.search(r"\$[a-z{]", rest), "a place that was not filled"


@pytest.mark.parametrize("recipe", KINDS)
def test_each_kind_of_shading_has_its_data(recipe: str) -> None:
    scripts = Reader(page(recipe)).scripts
    scene, kind = json.loads(scripts["scene"]), KINDS[recipe]
    assert scene["kind"] == kind
    assert scene["layers"] == LAYERS[kind]
    planes = gzip.decompress(base64.b64decode(scripts["records"]))
    assert len(planes) == 16 * TEXELS[kind] * scene["count"]
    assert bool(scripts.get("light")) is (kind != "plain")
    assert bool(scripts.get("network")) is (kind == "directional")


class Unknown(DeferredShading):
    """A model that the page has no shaders for."""


@page_shading.register
def _(shading: Unknown, gaussians: Parameters, light: Light) -> None:
    """None: colors are baked."""


def test_a_model_without_shaders_is_baked_and_says_so() -> None:
    state, _ = random_state("3dgs-dr")
    text = share_page(state.gaussians, state.light, Unknown(), ring(), first="v0", title="t")
    assert BAKED in text
    scripts = Reader(text).scripts
    scene = json.loads(scripts["scene"])
    assert (scene["kind"], scene["layers"]) == ("plain", LAYERS["plain"])
    assert not scripts.get("light")
    plain = share_page(state.gaussians, {}, PLAIN, ring(), first="v0", title="t")
    assert Reader(plain).scripts["records"] != scripts["records"], "colors without reflections"


def test_baked_harmonics_are_near_the_colors_that_they_stand_for() -> None:
    state, shading = random_state("3dgs-dr")
    even = {"texels": torch.full_like(state.light["texels"].detach(), 0.4)}
    values = baked_page(state.gaussians, even, shading).values
    directions = torch.nn.functional.normalize(
        torch.randn(40, 3, generator=torch.Generator().manual_seed(2)), dim=-1
    )
    expected = gaussian_colors(state.gaussians, even, shading, directions)
    found = torch.stack(
        [
            evaluate_sh(d.expand(len(expected), 3), torch.zeros(3), values["color"], values["harmonics"], 3)
            for d in directions
        ],
        dim=1,
    )
    # Of degree 3 but for the cut at black, which harmonics only come near to.
    assert float((found + 0.5 - expected).abs().mean()) < 0.02


def test_every_layer_has_words_and_scores_are_behind_a_switch() -> None:
    reader = Reader(page("polarguide-stokes"))
    scene = json.loads(reader.scripts["scene"])
    assert scene["words"].keys() == set(scene["layers"])
    assert all(words["label"] and words["sentence"] for words in scene["words"].values())
    assert scene["words"]["roughness"]["high"] == "matte"
    assert tuple(tag for tag in reader.tags if tag in ("details", "summary", "table")) == (
        "details",
        "summary",
        "table",
    )
    assert "open" not in [key for key, _ in reader.attributes]


def test_it_begins_at_the_best_view_and_brightens_dark_gloss() -> None:
    views = [SimpleNamespace(name=name) for name in ("a", "b", "c")]
    scores = {"views": {"a": {"psnr": 20.0}, "b": {"psnr": 30.0}}}
    assert web_page._best_view(views, scores, None).name == "b"
    health = SimpleNamespace(views={"c": SimpleNamespace(psnr=25.0), "a": SimpleNamespace(psnr=None)})
    assert web_page._best_view(views, None, health).name == "c"
    assert web_page._best_view(views, None, None).name == "a"
    alpha = torch.ones(10, 10)
    for brightest, times in ((0.2, 4.0), (1.5, 1.0), (1e-4, 16.0)):
        result = RenderResult({"specular": torch.full((10, 10, 3), brightest), "alpha": alpha})
        assert web_page._gloss(result) == times
    assert web_page._gloss(RenderResult({"alpha": alpha})) == 1.0


def test_the_same_run_gives_the_same_page() -> None:
    assert page() == page()


@pytest.mark.parametrize("recipe", KINDS)
def test_records_are_close_to_what_they_stand_for(recipe: str) -> None:
    state, shading = random_state(recipe)
    page = page_shading(shading, state.gaussians, state.light)
    assert page.kind == KINDS[recipe]
    data = records(state.gaussians, page.values)
    seen = torch.sigmoid(state.gaussians["opacity_logits"].detach()) >= 1 / 255
    assert len(data) == int(seen.sum())
    means = data["mean"]
    kept = state.gaussians["means"].detach()[seen].numpy()
    order = [int(np.flatnonzero((kept == mean).all(axis=1))[0]) for mean in means]
    assert sorted(order) == list(range(len(kept))), "every visible Gaussian once"
    opacity = data["opacity"] / 65535
    expected = torch.sigmoid(state.gaussians["opacity_logits"].detach())[seen].numpy()[order]
    np.testing.assert_allclose(opacity, expected, atol=1e-5)
    scales = data["scales"].astype(np.float32)
    np.testing.assert_allclose(
        np.exp(scales), state.gaussians["log_scales"].detach()[seen].exp().numpy()[order], rtol=2e-3
    )


def test_harmonics_keep_to_half_a_step() -> None:
    rest = (
        torch.randn(50, 15, 3, generator=torch.Generator().manual_seed(1))
        * torch.logspace(-4, 1, 50)[:, None, None]
    )
    rest[7] = 0
    steps, scale = harmonics_steps(rest)
    error = np.abs(steps * scale[:, None].astype(np.float32) - rest.flatten(1).numpy())
    assert (error <= 0.51 * scale[:, None].astype(np.float32) + 0.06 * np.abs(rest.flatten(1).numpy())).all()
    assert np.isfinite(scale.astype(np.float32)).all()


def test_credit_scale_and_white_are_in_the_page_as_text() -> None:
    state, shading = random_state("3dgs-dr")
    presentation = Presentation(
        white_balance=(0.5, 1.0, 2.0), up_axis=(0.0, 0.0, 3.0), meters_per_unit=0.25,
        author=EVIL, license=EVIL, provenance=EVIL,
    )  # fmt: skip
    arguments = (state.gaussians, state.light, shading, ring())
    plain = Reader(share_page(*arguments, first="v1", title="t"))
    text = share_page(*arguments, first="v1", title="t", presentation=presentation)
    found = Reader(text)
    assert EVIL not in text
    assert set(found.tags) == set(plain.tags)
    assert not any(key.startswith("on") for key, _ in found.attributes)
    assert [value for key, value in found.attributes if value == EVIL] == [EVIL] * 3  # what machines read
    scene = json.loads(found.scripts["scene"])
    assert scene["color"] == [0.5, 0, 0, 0, 1.0, 0, 0, 0, 2.0]
    assert (scene["metersPerUnit"], scene["up"]) == (0.25, [0.0, 0.0, 1.0])
    assert (json.loads(plain.scripts["scene"])["color"], "credit" in plain.scripts["scene"]) == (None, False)
    assert 'class="credit"' not in share_page(*arguments, first="v1", title="t")
