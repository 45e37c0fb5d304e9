"""Tables of guides, reference and explanation, computed again from benchmarks/records."""

import json
import sys
from pathlib import Path
from statistics import fmean, stdev

import pytest

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "benchmarks" / "records"
sys.path.append(str(ROOT / "benchmarks" / "accuracy"))
import capture_kinds  # noqa: E402
import unknown_angles  # noqa: E402
from markdown_tables import page_rows, page_table, row_lists, tables_of  # noqa: E402


def read_json(name):
    return json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))


def recorded_rows(name):
    """The rows of the only table of a printed record."""
    (table,) = row_lists((RECORDS / f"{name}.md").read_text(encoding="utf-8").splitlines())
    return table


def seeds_of(runs, prefix, key):
    return [run[key] for name, run in runs.items() if name.rpartition("/")[0] == prefix]


SHORT = {
    "`polarguide-stokes`": "ours",
    "its control": "control",
    "the control": "control",
    "`3dgs-dr:consistent`": "dr",
}
"""Recipes in the keys of few-photographs.json, by their names on the page."""
LIGHT = {"specular": "specular_psnr", "diffuse": "diffuse_psnr", "PSNR": "psnr"}


def test_few_photographs():
    runs = read_json("few-photographs")["runs"]
    for row in page_table("results/captures", "views, recipe"):
        views, _, recipe = row["views, recipe"].partition(", ")
        prefixes = [f"{scene}/{views}/{SHORT[recipe]}" for scene in ("spheres", "cup", "car")]
        normals = [seeds_of(runs, prefix, "normal_mae_deg") for prefix in prefixes]
        assert {len(values) for values in normals} == {3}
        stated = " / ".join(f"{fmean(values):.1f} ± {stdev(values):.1f}" for values in normals)
        assert row["normal error (deg)"] == stated
        for heading, key in LIGHT.items():
            means = [fmean(seeds_of(runs, prefix, key)) for prefix in prefixes]
            assert row[heading] == " / ".join(f"{mean:.1f}" for mean in means)


def test_noise():
    runs = read_json("few-photographs")["runs"]
    for row in page_table("results/captures", "noise"):
        pair = [f"noise/spheres/{row['noise']}/{recipe}" for recipe in ("ours", "control")]
        for heading, key in (LIGHT | {"normal error (deg)": "normal_mae_deg"}).items():
            assert row[heading] == " / ".join(f"{fmean(seeds_of(runs, each, key)):.1f}" for each in pair)


def test_unknown_angles():
    searches = read_json("unknown-angles-wwbottle")["searches"]
    all_unknown, third = page_table("results/captures", "unknown", "pictures")
    for row, chosen in (
        (all_unknown, [each for each in searches if each["folds"] == 1]),
        (third, [each for each in searches if each["folds"] > 1]),
    ):
        pictures, error, _, over, doubtful, others, *_ = unknown_angles.summary(chosen)
        assert [*row.values()][1:] == [pictures, f"{error}°", over, doubtful, f"{others}°"]


def test_burning_and_the_worst_view_of_single_shots():
    runs = {name: run for name, run in read_json("single-shots").items() if not name.startswith("before")}
    shots = {name: run for name, run in runs.items() if not name.startswith("four")}
    assert {name.split("-")[1] for name in shots} == {"cup", "car", "kit", "water"}
    share = max(value for run in shots.values() for key, value in run.items() if key.startswith("burning"))
    text = " ".join((ROOT / "docs" / "results" / "captures.md").read_text(encoding="utf-8").split())
    assert f"At most {100 * share:.2f} % of the pixels of a view burn" in text
    water = [runs["four-water-0"]["worst"] - runs[f"known-water-{seed}"]["worst"] for seed in (0, 1)]
    assert f"On `water` with known angles, the loss is {max(water):.1f} dB" in text


def test_kinds_of_capture():
    (computed,) = tables_of(capture_kinds.table(read_json("capture-kinds")))
    assert page_table("how-to/capture", "capture", "files per view") == computed


def test_trainings_with_normal_maps():
    runs = read_json("normal-maps")["runs"]
    columns = {
        "PSNR (dB)": ("psnr", 1, 1),
        "foreground PSNR (dB)": ("psnr_foreground", 1, 1),
        "normal error (degrees)": ("normal_mae_deg", 1, 1),
        "depth error (%)": ("depth_error_median_percent", 2, 1),
        "mesh F-score 1 %": ("mesh_fscore_1", 1, 100),
    }
    for row in page_table("how-to/normal-maps", "scene", "PSNR (dB)"):
        scene = row["scene"].strip("`")
        for heading, (key, digits, factor) in columns.items():
            means = [
                factor * fmean(seeds_of(runs, f"{scene}/{recipe}", key))
                for recipe in ("3dgs", "3dgs with normal maps")
            ]
            assert row[heading] == " → ".join(f"{mean:.{digits}f}" for mean in means)


def test_calibration_of_simulated_sensors():
    recorded = recorded_rows("calibration")
    for row in page_rows("how-to/calibrate", "shots", "monochrome: DoLP"):
        assert row in recorded
    last = (RECORDS / "calibration.md").read_text(encoding="utf-8").splitlines()[-1]
    factors = last.removeprefix("Calibration divides the errors by ").removesuffix(".")
    text = " ".join((ROOT / "docs" / "how-to" / "calibrate.md").read_text(encoding="utf-8").split())
    assert f"by a factor of {factors}" in text


@pytest.mark.parametrize(
    ("number", "headings"),
    [(0, ("scene and source of the gains", "median error")), (1, ("scene", "registered of"))],
)
def test_gains_and_poses_of_single_shots(number, headings):
    lines = (RECORDS / "filter-shots.md").read_text(encoding="utf-8").splitlines()
    assert page_rows("reference/formats", *headings) == row_lists(lines)[number]


def test_exported_splats():
    stated = page_rows("how-to/export", "run of `polarguide-stokes`", "exported splats")
    assert stated[1:] == recorded_rows("baked-splats")[1:]


def test_splats_in_other_engines():
    stated = page_rows("how-to/export", "run of `polarguide-stokes`", "three.js")
    assert stated == recorded_rows("engines")


def test_depth_of_an_exported_mesh():
    assert page_rows("how-to/export", "depth", "median error") == recorded_rows("mesh-depth")


def test_models_in_blender():
    assert page_rows("how-to/textured-model", "model", "learned light") == recorded_rows("blender")


def test_times_of_measure():
    assert page_rows("how-to/inspection-line", "`--demosaic`", "whole picture") == recorded_rows("measuring")


def test_shared_pages():
    assert page_rows("how-to/share", "run", "Gaussians", "file") == recorded_rows("shared-pages")


def test_verdicts_of_inspection():
    recorded = recorded_rows("inspection")
    stated = page_rows("explanation/angle-order", "test", "spheres")
    assert [row for row in stated if row not in recorded] == []
    faults = [
        row[1:] for row in recorded if row[0].endswith("longer") or "gamma" in row[0] or "times" in row[0]
    ]
    assert faults == [["reported"] * 4] * 6


def test_base_colors():
    lines = (RECORDS / "base-color.md").read_text(encoding="utf-8").splitlines()
    recorded = {heading[0]: {row[0]: row[1:] for row in rows} for heading, *rows in row_lists(lines)}
    heading, *models = page_rows("how-to/textured-model", "`--base-color`", "`kit`")
    for name, *cells in models:
        for place, scene in enumerate(heading[1::2]):
            score, _, factor = recorded[f"model of {scene}"][name]
            assert cells[2 * place : 2 * place + 2] == [score, factor]
    heading, scores, roughness = page_rows("how-to/textured-model", "object of `cup`")
    objects = recorded[heading[0]]
    assert heading[1:] == [*objects]
    assert scores[1:] == [objects[name][0] for name in heading[1:]]
    assert roughness[1:] == [f"{objects[name][1]} ({objects[name][2]})" for name in heading[1:]]
    pairs = [
        [float(cell) for cell in row[1:]]
        for title, table in recorded.items()
        if title.startswith("object")
        for row in table.values()
    ]
    wrong = sum(abs(found - true) > 0.075 for found, true in pairs)
    text = (ROOT / "docs" / "how-to" / "textured-model.md").read_text(encoding="utf-8")
    assert f"wrong by 0.08 or more for {wrong} of {len(pairs)} objects" in text


def test_alignment_of_half_size_pictures():
    assert page_rows("reference/formats", "", "DoLP, not registered") == recorded_rows("half-size")


def test_normals_from_color():
    heading, *rows = recorded_rows("optics")
    recorded = {row[0]: dict(zip(heading, row, strict=True)) for row in rows}
    one = {
        "share of the foreground with a normal from color (%)": "color: share of mask decided, percent",
        "part of this share that is taken for the wrong kind of light (%)": (
            "color: of those the wrong lobe, percent"
        ),
    }
    pairs = {
        "error of these normals, mean / median (deg)": "color: normal error",
        "error of the best of six candidates, mean / median (deg)": "best of six",
    }
    for row in page_table("results/ablations", "", "spheres"):
        label = row.pop("")
        for scene, cell in row.items():
            if label in pairs:
                both = [recorded[f"{pairs[label]}, {kind}"][scene] for kind in ("mean", "median")]
                assert cell == " / ".join(both)
            else:
                assert cell == recorded[one[label]][scene]


GPU = {
    "forward, ms": "forward_ms",
    "forward and backward, ms": "forward_backward_ms",
    "training step, ms": "step_ms",
    "final picture, frames a second": "fps",
}


@pytest.mark.parametrize(("column", "part"), [(1, "demo"), (3, "spheres"), (5, "stress")])
def test_times_on_a_gpu(column, part):
    record = read_json("gpu-nvidia-h100-80gb-hbm3")[f"bench-{part}"]
    rows = {row[0]: row for row in page_rows("explanation/gpu", "", "demo: polarguide")}
    assert rows["pixels"][column] == " x ".join(map(str, record["size"]))
    count = f"{record['gaussians']:,}"
    assert rows["Gaussians"][column] == ("a million" if count == "1,000,000" else count)
    for place, side in ((column, "ours"), (column + 1, "plain")):
        for label, key in GPU.items():
            assert rows[label][place] == f"{float(f'{record[side][key]:.3g}'):g}"
        assert rows["peak memory, MiB"][place] == f"{record[side]['peak_mib']:.0f}"
