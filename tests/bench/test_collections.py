"""A batch: what fails alone, what goes on, what excludes what, and the page over all."""

import os
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import msgspec
import pandas as pd
import pytest
from faults import Fault
from heard import Heard
from tiny_capture import ideal_intensities, write_tiny_capture

from polarguide.core.options import SceneOptions
from polarguide.core.records import decode
from polarguide.preparation.settings import PrepareSettings
from polarguide.runs.folder import RunConfiguration
from polarguide.training.settings import TrainSettings
from polarguide_bench import job_queue
from polarguide_bench.batch import CaptureRow, _tasks, run_batch, write_page
from polarguide_bench.children import FORMAT, STEPS, Capture, CaptureRecord, Message, prepare_settings
from polarguide_bench.compare import locked
from polarguide_bench.options import BatchOptions

OPTIONS = BatchOptions(jobs=1, device="cpu")


@pytest.fixture(scope="module")
def collection(tmp_path_factory: pytest.TempPathFactory) -> list[Capture]:
    """Three captures, of which two are broken: one has a picture that is cut short, the other nothing to read."""
    root = tmp_path_factory.mktemp("collection")
    good, cut, empty = root / "good", root / "cut", root / "empty <b>"
    tiny = write_tiny_capture(good)
    for number, name in enumerate(tiny.linear):
        tiny.write_view(name, ideal_intensities(number, height=24, width=24))
    tiny.write_cameras("1 PINHOLE 24 24 31 31 12 12")
    picture = write_tiny_capture(cut).picture("v003", 45)
    picture.write_bytes(picture.read_bytes()[:50])
    empty.mkdir()
    how: dict[str, Any] = {"recipes": ("3dgs",), "settings": TrainSettings(20), "reading": SceneOptions()}
    return [Capture(path.name, path, **how) for path in (good, cut, empty)]


def stop_when(done: Callable[[], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C as soon as the condition is true."""
    whole = job_queue._Progress.report

    def report(self: Any, *arguments: Any) -> None:
        whole(self, *arguments)
        if done():
            monkeypatch.undo()
            raise KeyboardInterrupt

    monkeypatch.setattr(job_queue._Progress, "report", report)


@pytest.mark.slow
def test_broken_captures_are_rows_and_the_others_go_on_also_after_a_stop(
    collection: list[Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = tmp_path / "captures" / collection[0].name

    def inspected() -> bool:
        record = CaptureRecord.load(good)
        return record is not None and "inspect" in record.done

    stop_when(inspected, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        run_batch(collection, tmp_path, OPTIONS)
    with locked(tmp_path, "batch"):  # nothing is left at work
        page = (good / "inspection" / "inspection.html").stat().st_mtime_ns

    heard = Heard()
    rows = run_batch(collection, tmp_path, OPTIONS, reporter=heard)
    assert (good / "inspection" / "inspection.html").stat().st_mtime_ns == page
    assert [row.state for row in rows] == ["done", "failed", "failed"]
    assert "cut short" in rows[1].error
    assert "nothing to read" in rows[2].error
    assert rows[0].record.done == STEPS

    html = (tmp_path / "index.html").read_text()
    assert "<b>" not in html.partition("<tbody>")[2]
    assert all(row.error in unescape(html) for row in rows)
    links = re.findall(r'href="([^"]+)"', html)
    assert [Path(link).name for link in links] == [
        "inspection.html", "errors.png", "share.html", "splats.ply",
    ]  # fmt: skip
    assert all((tmp_path / link).exists() for link in links)
    table = pd.read_csv(tmp_path / "results.csv")
    assert table["state"].tolist() == ["done", "failed", "failed"]
    assert table["psnr"].notna().tolist() == [True, False, False]

    # Finished captures are not repeated; other options for them, or other files, are refused by name.
    run_batch(collection[:1], tmp_path, OPTIONS, reporter=heard)
    assert heard.said[-1] == "captures: 1, of them finished before: 1"
    other = _tasks(replace(collection[0], settings=TrainSettings(30)), tmp_path, OPTIONS)[0]
    Fault(str(good), "(settings)", "other values").raised_by(rows[0].record.require, other.request, good)

    # Another recipe trains on the prepared scene, and has a row of its own.
    several = [replace(collection[0], recipes=("3dgs", "ref-gs"))]
    rows = run_batch(several, tmp_path, OPTIONS)
    assert [(row.name, row.recipe, row.state) for row in rows] == [
        ("good", "3dgs", "done"), ("good", "ref-gs", "done"),
    ]  # fmt: skip
    assert (good / "inspection" / "inspection.html").stat().st_mtime_ns == page
    assert rows[1].record.verdict == rows[0].record.verdict != ""
    assert (tmp_path / "captures-ref-gs" / "good" / "share.html").exists()
    assert RunConfiguration.load(tmp_path / "captures-ref-gs" / "good" / "run").recipe == "ref-gs"
    table = pd.read_csv(tmp_path / "results.csv")
    assert table["recipe"].tolist() == ["3dgs", "ref-gs"]
    assert table["psnr"].notna().all()


def test_each_recipe_has_its_own_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    request = _tasks(Capture("a", tmp_path, PrepareSettings()), tmp_path, OPTIONS)[0].request
    record = CaptureRecord(FORMAT, request, done=STEPS, verdict="ok")
    rows = [
        CaptureRow("a", recipe, "", tmp_path / "captures" / recipe, "done", "", record)
        for recipe in ("3dgs", "ref-gs")
    ]
    monkeypatch.setattr(
        CaptureRow, "scores", lambda row: {"psnr": {"3dgs": 21.0, "ref-gs": 32.0}[row.recipe]}
    )
    monkeypatch.setattr(CaptureRow, "remarks", lambda row: ())
    write_page(tmp_path, rows)
    assert pd.read_csv(tmp_path / "results.csv")["psnr"].tolist() == [21.0, 32.0]
    html = (tmp_path / "index.html").read_text()
    assert html.index("21.00") < html.index("32.00")


def test_two_in_one_folder_exclude_each_other(collection: list[Capture], tmp_path: Path) -> None:
    with locked(tmp_path, "batch"):
        Fault("", "no other command").raised_by(run_batch, collection, tmp_path, OPTIONS)
    Fault("recipe").raised_by(
        run_batch, [replace(collection[0], recipes=("magic",))], tmp_path / "new", OPTIONS
    )
    twice = replace(collection[0], recipes=("3dgs", "3dgs"))
    Fault("good (recipe)", "different recipes", "3dgs 3dgs").raised_by(
        run_batch, [twice], tmp_path / "new", OPTIONS
    )
    assert not (tmp_path / "new").exists()


def test_a_capture_is_known_by_its_content(tmp_path: Path) -> None:
    folder, source = tmp_path / "captures" / "a", tmp_path / "a"
    (source / "0").mkdir(parents=True)
    (source / "0" / "v.png").write_bytes(b"123")
    begun = _tasks(Capture("a", source, PrepareSettings()), tmp_path, OPTIONS)[0].request
    record = CaptureRecord(FORMAT, begun)
    folder.mkdir(parents=True)
    record.save(folder)
    os.utime(source / "0" / "v.png", ns=(1, 1))
    moved = source.rename(tmp_path / "moved")
    again = _tasks(Capture("a", moved, PrepareSettings()), tmp_path, OPTIONS)[0].request
    assert again.stamp != begun.stamp
    record.require(again, folder)
    (moved / "0" / "v.png").write_bytes(b"124")  # as large
    changed = _tasks(Capture("a", moved, PrepareSettings()), tmp_path, OPTIONS)[0].request
    Fault(str(folder), "(stamp)", "changed files").raised_by(record.require, changed, folder)
    old = CaptureRecord(FORMAT, msgspec.structs.replace(begun, digest=""))  # of an earlier version
    Fault(str(folder), "(stamp)", "changed files").raised_by(old.require, again, folder)


@pytest.mark.parametrize("content", ["{", "[]", '{"views": 3}', "\0", None])
def test_damaged_health_is_a_remark_of_its_capture(tmp_path: Path, content: str | None) -> None:
    folder = tmp_path / "captures" / "a"
    (folder / "run").mkdir(parents=True)
    if content is None:
        (folder / "run" / "health.json").symlink_to("nowhere")
    else:
        (folder / "run" / "health.json").write_text(content)
    request = _tasks(Capture("a", tmp_path, PrepareSettings()), tmp_path, OPTIONS)[0].request
    row = CaptureRow(
        "a",
        "3dgs",
        "",
        folder,
        "done",
        "",
        CaptureRecord(FORMAT, request, done=("prepare", "train"), findings=("x",)),
    )
    first, second = row.remarks()
    assert first == "x"
    assert "health.json" in second
    assert "expected a" in second


def test_settings_survive_their_way(tmp_path: Path) -> None:
    settings = PrepareSettings(sensor="IMX250MYR", dark_frame=tmp_path / "dark.png", poses="sfm").checked()
    task = _tasks(Capture("a", tmp_path, settings), tmp_path, OPTIONS)[0]
    assert task.request.prepare is not None
    assert prepare_settings(task.request.prepare) == settings
    assert decode(Message(task, "", "").to_line(), Message, "task").task == task
