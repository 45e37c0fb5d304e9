"""``polarguide inspect`` from the command line: page, record, and wrong input."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from polarguide.cli.app import run
from polarguide.inspection.inspect import LAYERS

VOID = {"meta", "input", "img", "br"}


class Tags(HTMLParser):
    """Collects tags and checks that they close."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@pytest.fixture(scope="module")
def unposed(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views of the demo without poses, one with a name that HTML would read."""
    root = tmp_path_factory.mktemp("inspect") / "scene <b>&amp;"
    (root / "polar").mkdir(parents=True)
    for old, new in (("v000", "v000"), ("v022", "v022"), ("v044", "<i>ü\"'&</i>".replace("/", "\u2215"))):
        for angle in ("000", "045", "090", "135"):
            shutil.copy(demo_scene / "polar" / f"{old}_{angle}.png", root / "polar" / f"{new}_{angle}.png")
    return root


def inspected(root: Path, out: Path, *more: str) -> tuple[dict, str]:
    assert run(["inspect", str(root), "--out", str(out), "--threads", "1", *more]) == 0
    return (
        json.loads((out / "inspection.json").read_text("utf-8")),
        (out / "inspection.html").read_text("utf-8"),
    )


def test_a_capture_without_poses(unposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record, page = inspected(unposed, tmp_path / "out")
    verdicts = {check["key"]: check["verdict"] for check in record["checks"]}
    assert record["schema"] == 2
    assert record["scene"]["posed_views"] == 0
    for key in ("poses", "coverage", "view_exposure", "focal_lengths", "held_out"):
        assert verdicts.pop(key) == "n/a"
    for key in ("angle_order", "handedness", "zero_offset"):
        assert verdicts.pop(key) == "not verified"
    assert set(verdicts.values()) == {"ok"}
    assert record["verdict"] == "not verified"
    assert len(record["views"]) == 3
    printed = capsys.readouterr()
    assert "Traceback" not in printed.out + printed.err
    assert "inspection.html" in printed.out
    said = "verdict: not verified: order of the angles, sense of the angles, zero of the angles"
    assert said in printed.out
    assert printed.out.count("Prepare the scene with poses") == 1
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    kinds = [tag for tag, _ in tags.found]
    assert kinds.count("img") == 3 * len(LAYERS) + 1, "and the wheel"
    assert "script" not in kinds
    assert "<i>ü" not in page
    assert "scene <b>" not in page
    assert "&lt;i&gt;ü" in page
    outside = [
        a
        for _, attrs in tags.found
        for k in ("src", "href")
        if (a := attrs.get(k)) and not a.startswith("data:")
    ]
    assert outside == []
    assert not re.search(r"url\(|@import|https?:", page)


def test_a_capture_with_poses_and_points_alone(whole_demo: Path, tmp_path: Path) -> None:
    record, _ = inspected(whole_demo, tmp_path / "out", "--normals", "points")
    verdicts = {check["key"]: check["verdict"] for check in record["checks"]}
    assert verdicts["angle_order"] == "ok"
    assert record["angles"]["sources"][0]["usable"] is True
    assert verdicts["coverage"] == "ok"
    assert record["scene"]["posed_views"] == 50
