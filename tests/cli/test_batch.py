"""``polarguide batch``: what names captures, what their options mean, and which tables are refused."""

from pathlib import Path
from typing import Any

import pytest
from faults import Fault

from polarguide.cli.app import run
from polarguide_bench import batch as batches
from polarguide_bench import verbs
from polarguide_bench.children import Capture
from polarguide_bench.options import BatchOptions

OPTIONS = BatchOptions(jobs=1, device="cpu")
HEAD = "name,path,sensor,options\n"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("name,where\n", Fault("first line", "name and path", "where")),
        ("", Fault("first line", found="nothing")),
        (HEAD, Fault("list.csv", found="no capture")),
        (HEAD + "cup,a\n", Fault("line 2", "4 values", "fewer")),
        (HEAD + "cup,a,,,,\n", Fault("line 2", "4 values", "more")),
        (HEAD + "../cup,a,,\n", Fault("line 2", "name")),
        (HEAD + "cup,,,\n", Fault("line 2", "path")),
        (HEAD + "cup,a,,\n\nCup,b,,\n", Fault("line 4", "different names", "line 2")),
        (HEAD + "cup,a\0b,,\n", Fault("line 2", found="a null character")),
        (HEAD + "cup\0,a,,\n", Fault("line 2", found="a null character")),
        (HEAD + "cup,a,,\n" + 'mug,"b,,\n', Fault("line 3", found="unexpected end of data")),
        (HEAD + 'cup,"' + 140_000 * "a" + "\n", Fault("line 2", found="field larger than field limit")),
        ('name,path,"sensor\n' + 140_000 * "a", Fault("line 1", found="field larger than field limit")),
        (HEAD + "cup,a,IMX,\n", Fault("line 2), --sensor", "IMX250MYR", "IMX")),
        (HEAD + "cup,a,,--stepz 3\n", Fault("line 2", "prepare and train", "--stepz")),
        (HEAD + 'cup,a,,"--steps ""3"\n', Fault("line 2", "command line")),
        (HEAD + "cup,a,,--steps 0\n", Fault("line 2), steps", "1 or more", "0")),
        (HEAD + "cup,a,,--intrinsics red\n", Fault("line 2), --intrinsics", found="red")),
    ],
)
def test_a_wrong_table_is_refused_before_anything_is_written(tmp_path: Path, text: str, fault: Fault) -> None:
    (tmp_path / "list.csv").write_text(text)
    fault.raised_by(verbs.batch, tmp_path / "list.csv", out=tmp_path / "out", settings=OPTIONS)
    assert not (tmp_path / "out").exists()


def test_tables_and_folders_name_captures(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Options are those of prepare and of train, common ones first; a scene with poses takes those of train alone."""
    asked: list[list[Capture]] = []

    def instead(captures: list[Capture], out: Path, *_: Any, **__: Any) -> list[Any]:
        asked.append(captures)
        return []

    monkeypatch.setattr(batches, "run_batch", instead)
    (tmp_path / "list.csv").write_text(
        "\ufeffName; path; sensor; options\n"
        "cup; shots/cup; imx250myr; --poses none --steps 40 --zero 12\n"
        f"demo; {demo_scene}; ; --recipe 3dgs ref-gs --downscale 2\n",
        encoding="utf-8",
    )
    out = str(tmp_path / "out")
    assert run(["batch", str(tmp_path / "list.csv"), "--out", out, "--options=--steps 7"]) == 0
    cup, demo = asked.pop()
    assert (cup.name, cup.path) == ("cup", tmp_path / "shots" / "cup")
    assert (cup.prepare.sensor, cup.prepare.poses, cup.prepare.calibration.zero) == ("IMX250MYR", "none", 12)
    assert (cup.settings.steps, cup.recipes) == (40, ("polarguide-stokes",))
    assert (demo.path, demo.recipes, demo.settings.steps, demo.reading.downscale) == (
        demo_scene,
        ("3dgs", "ref-gs"),
        7,
        2,
    )

    for name in ("b", "a", ".hidden", "out"):
        (tmp_path / "all" / name).mkdir(parents=True)
    (tmp_path / "all" / "notes.txt").touch()
    assert run(["batch", str(tmp_path / "all"), "--out", str(tmp_path / "all" / "out")]) == 0
    assert [capture.name for capture in asked.pop()] == ["a", "b"]
