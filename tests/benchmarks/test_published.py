"""``benchmarks/public/published.py`` compares measured scores of published datasets with published scores."""

import sys
from pathlib import Path

import pytest
from comparison_records import results, run, unfinished
from dataset_files import WRITERS
from faults import Fault

from polarguide.capture import load_scene
from polarguide_bench.results import Results

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "public"))

import published

CAPTURES = {"pandora": "gnome", "pisr": "gundam", "nersp": "dog", "neisf": "pot"}


@pytest.mark.parametrize("name", published.PUBLISHED_DATASETS)
def test_a_capture_and_a_folder_of_captures_are_found(name: str, tmp_path: Path) -> None:
    if name == "neisf":
        pytest.importorskip("OpenEXR")
    captures = [WRITERS[name](tmp_path / "all" / capture) for capture in ("a", "b")]
    (tmp_path / "all" / "notes").mkdir()
    assert published.find_captures(tmp_path / "all", name) == captures
    assert published.find_captures(captures[0], name) == captures[:1]


def test_other_datasets_and_missing_folders_are_refused(tmp_path: Path) -> None:
    WRITERS["pandora"](tmp_path / "gnome")
    Fault("gnome", "PISR", "pandora", "Unpack the dataset").raised_by(
        published.find_captures, tmp_path / "gnome", "pisr"
    )
    Fault("nothing", "NeRSP", "no folder", "Unpack the dataset").raised_by(
        published.find_captures, tmp_path / "nothing", "nersp"
    )


@pytest.mark.parametrize("recipes", [["3dgs"], ["3dgs", "3dgs"], ["3dgs", "polarguide"]])
def test_too_few_recipes_are_refused_before_the_training(recipes: list[str]) -> None:
    Fault("--recipes", "at least two of gnerp, 3dgs", " ".join(recipes), "Add recipes").raised_by(
        published.check_recipes, recipes
    )


@pytest.mark.parametrize(
    "arguments", [["owl"], ["pandora", "x"], ["pandora", "x", "--out", "y", "--steps", "many"]]
)
def test_wrong_arguments_end_with_the_usage(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["published.py", *arguments])
    with pytest.raises(SystemExit):
        published.main()
    assert "usage: published.py" in capsys.readouterr().err


@pytest.mark.parametrize("name", published.PUBLISHED_DATASETS)
def test_measured_scores_are_next_to_published_ones(name: str) -> None:
    scored = [run(CAPTURES[name], recipe, 0, psnr=20.125, ssim=0.8) for recipe in ("3dgs", "3dgs-dr")]
    sections = {section.key: section for section in published.published_sections(results(scored), name)}
    measured = sections["publication-1"]
    assert measured.title.startswith("Measured on ")
    assert [cell[0] for cell in measured.blocks[0][1][0][1]] == ["20.12", "20.12"]
    values = {
        title: [cell[0] for cell in rows[0][1]]
        for title, rows in (sections["publication-1-published"].blocks if len(sections) == 3 else ())
    }
    assert values == {
        "pandora": {"Gnome (indoor)": ["17.65", "19.37", "21.13", "21.65", "22.54"]},
        "pisr": {"Gundam (indoor)": ["15.42", "22.78", "22.93", "22.85", "23.32"]},
    }.get(name, {})
    notes = " ".join(sections["conditions"].notes)
    assert ("No published scores are recorded" in notes) == (name in ("nersp", "neisf"))
    assert ("Chamfer distance of 0.5 mm" in notes) == (name == "pisr")


def test_captures_without_published_scores_are_named() -> None:
    scored = [
        run(scene, recipe, 0, psnr=20.0) for scene in ("gnome", "owl") for recipe in ("3dgs", "3dgs-dr")
    ]
    *_, last = published.published_sections(results(scored), "pandora")
    assert "No published scores are recorded for owl." in last.notes


@pytest.mark.filterwarnings("ignore:The sense of")
@pytest.mark.parametrize("name", published.PUBLISHED_DATASETS)
def test_the_command_prepares_and_a_failed_run_ends_with_its_error_after_the_table(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "neisf":
        pytest.importorskip("OpenEXR")
    capture = CAPTURES[name]
    WRITERS[name](tmp_path / capture)
    scored = results([run(capture, "3dgs", 0, psnr=20.0), unfinished(capture, "3dgs-dr", 0, "no memory")])
    compared: list[Path] = []

    def compare(scenes: list[Path], *_: object, **__: object) -> Results:
        compared.extend(scenes)
        return scored

    monkeypatch.setattr(published.polarguide, "compare", compare)
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["published.py", name, str(tmp_path / capture), "--out", str(out)])
    Fault(name, "2 finished runs", f"{capture}, 3dgs-dr, seed 0: no memory", "repeat").raised_by(
        published.main
    )
    assert [len(load_scene(scene).train_views) > 0 for scene in compared] == [True]
    assert "| PSNR ↑ |" in (out / "published.md").read_text()
