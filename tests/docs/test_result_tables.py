"""Tables of docs/results, computed again from the records in benchmarks/results."""

import json
import sys
from pathlib import Path
from statistics import fmean

import pytest

from polarguide.core.errors import PolarguideError
from polarguide_bench.join import LAYOUTS, measured_section
from polarguide_bench.results import Results, read_results
from polarguide_bench.tables import against_section

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "benchmarks" / "results"
sys.path.append(str(ROOT / "benchmarks" / "accuracy"))
import bench_tables  # noqa: E402
import losses  # noqa: E402
import paired_runs  # noqa: E402
from bench_records import of_run, read_scenes, values  # noqa: E402
from markdown_tables import page_table as table_of_page  # noqa: E402
from markdown_tables import tables_of  # noqa: E402

BENCH = (
    *("figure", "kit", "car", "water", "metals-a", "ceramic-a"),
    *("metals-b", "ceramic-b", "cup", "rough", "lacquer"),
)
FOUR = ("spheres", "cup", "car", "water")
NEW = ("workbench", "sideboard", "pantry", "picnic", "bathroom", "tortoise")
NEW_FOLDER = "final/heldout"
METALS = {"final/bench": ("kit", "car", "metals-a", "cup", "metals-b"), "final/metals": ("alloys", "frame")}
LAYERS = {"specular": "specular PSNR", "diffuse": "diffuse PSNR"}
WITHOUT_METALS = {name: f"{heading} without metals" for name, heading in LAYERS.items()}
OTHERS = losses.without_polarization(bench_tables.RECIPE)


def scenes_of(folder, names):
    return read_scenes([RECORDS / folder / f"{name}.json" for name in names])


def page_table(page, *headings):
    """The table of a page of results whose first headings are these."""
    return table_of_page(f"results/{page}", *headings)


def page_text(page):
    """Text of a page of results with single spaces."""
    return " ".join((ROOT / "docs" / "results" / f"{page}.md").read_text(encoding="utf-8").split())


def printed(lines):
    """Rows of a printed table by the first cell."""
    (table,) = tables_of(list(lines))
    return {next(iter(row.values())): row for row in table}


def assert_equal_tables(stated, computed, names):
    for row in stated:
        (first, label), *cells = row.items()
        expected = {heading: computed[label][names.get(heading, heading)] for heading, _ in cells}
        assert {first: label, **expected} == row


@pytest.mark.parametrize(
    ("page", "headings", "folder", "scenes", "layers"),
    [
        ("../index", ("method", "PSNR"), "", ("front",), LAYERS),
        ("index", ("recipe, eleven scenes",), "final/bench", BENCH, WITHOUT_METALS),
        ("index", ("recipe, picture of four scenes",), "final/four", FOUR, LAYERS),
        ("index", ("recipe, surface and layers of four scenes",), "final/four", FOUR, LAYERS),
        ("index", ("recipe", "PSNR", "Stokes error"), "four", ("wwbottle",), {}),
        ("new-scenes", ("recipe", "PSNR"), NEW_FOLDER, NEW, LAYERS),
        ("captures", ("angles of each view",), "", ("exposures",), LAYERS),
    ],
)
def test_means_over_scenes(page, headings, folder, scenes, layers):
    computed = printed(bench_tables.mean_table(scenes_of(folder, scenes)))
    assert_equal_tables(page_table(page, *headings), computed, layers)


@pytest.mark.parametrize(
    ("page", "heading", "folder", "scenes", "layers"),
    [
        ("new-scenes", "scene", NEW_FOLDER, NEW, WITHOUT_METALS),
        ("index", "scene, gain by polarization", "final/four", FOUR, LAYERS),
    ],
)
def test_gains_by_scene(page, heading, folder, scenes, layers):
    computed = printed(bench_tables.control_table(scenes_of(folder, scenes)))
    assert_equal_tables(page_table(page, heading, "PSNR"), computed, layers)


@pytest.mark.parametrize(
    ("page", "folder", "scenes"),
    [("index", "final/bench", BENCH), ("new-scenes", NEW_FOLDER, NEW)],
)
def test_values_by_material(page, folder, scenes):
    (table,) = tables_of(bench_tables.material_table(scenes_of(folder, scenes)))
    stated = page_table(page, "material", "normal error (deg)")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in table]


def test_losses():
    lines = list(losses.loss_tables(scenes_of(NEW_FOLDER, NEW), bench_tables.RECIPE, OTHERS))
    by_scene, by_method, _ = tables_of(lines)
    stated = page_table("new-scenes", "scene", "losses by scene")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in by_scene]
    method = page_table("new-scenes", "method", "losses")
    assert [[*row.values()] for row in method] == [[*row.values()] for row in by_method]
    text = page_text("new-scenes")
    assert lines[0] in text
    for stating in ("README.md", "docs/results/index.md"):
        assert f"loses {by_method[0]['losses']} comparisons" in (ROOT / stating).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("folder", "scenes", "heading"), [("final/four", FOUR, "method"), ("final/bench", BENCH, "method, bench")]
)
def test_losses_of_rendered_scenes(folder, scenes, heading):
    text = page_text("index")
    lines = list(losses.loss_tables(scenes_of(folder, scenes), bench_tables.RECIPE, OTHERS))
    _, by_method, _ = tables_of(lines)
    assert lines[0].removesuffix(".") in text
    assert f"loses {by_method[0]['losses']} comparisons" in text
    stated = page_table("index", heading, "losses")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in by_method]


def test_sets_with_scenes_of_one_name_are_refused():
    paths = [RECORDS / "final" / part / "cup.json" for part in ("four", "bench")]
    with pytest.raises(PolarguideError, match=r"bench/cup\.json.*cup, 3dgs, seed 0 for the second time"):
        read_scenes(paths)


def test_an_unknown_recipe_is_refused():
    scenes = scenes_of("final/bench", ["cup"])
    bench_tables.check_recipes(scenes, ["3dgs", "ref-gs"])
    with pytest.raises(PolarguideError, match="3dgss"):
        bench_tables.check_recipes(scenes, ["3dgs", "3dgss"])


@pytest.mark.parametrize(
    ("page", "scenes_by_folder"),
    [("new-scenes", {NEW_FOLDER: NEW}), ("metals", METALS)],
)
def test_metals(page, scenes_by_folder):
    scenes = {}
    for folder, names in scenes_by_folder.items():
        scenes.update(scenes_of(folder, names))
    (table,) = tables_of(bench_tables.metal_table(scenes))
    stated = page_table(page, "scene", "object")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in table]


def test_gains_by_detection_of_metals():
    record = json.loads(
        (ROOT / "benchmarks" / "paired" / "metals-dielectric.json").read_text(encoding="utf-8")
    )
    (table,) = tables_of(paired_runs.summary(record))
    stated = page_table("metals", "scene", "found metals")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in table]


def test_gains_by_an_own_refractive_index():
    record = json.loads((ROOT / "benchmarks" / "paired" / "water-index.json").read_text(encoding="utf-8"))
    (table,) = tables_of(paired_runs.table(record["runs"]["water"], record["less"]["water"]))
    computed = {row.pop(""): row for row in table}
    for row in page_table("ablations", "object", "PSNR"):
        assert row.items() <= {"object": row["object"], **computed[row["object"]]}.items()
    others = computed.keys() - {paired_runs.WHOLE, paired_runs.DIELECTRICS, "water"}
    lost = sorted(
        -float(computed[name]["specular"].split()[0].replace(paired_runs.MINUS, "-")) for name in others
    )
    assert len(lost) == 6
    assert f"six other objects lose {lost[0]:.1f} to {lost[-1]:.1f} dB" in page_text("ablations")


def test_mean_gains_on_new_scenes():
    (table,) = tables_of(losses.gain_table(scenes_of(NEW_FOLDER, NEW), bench_tables.RECIPE, OTHERS))
    stated = page_table("new-scenes", "compared with")
    assert [[*row.values()] for row in stated] == [[*row.values()] for row in table]


@pytest.mark.parametrize(
    ("layout", "last"), [("publication-1", "polarguide-stokes"), ("publication-2", None)]
)
def test_tables_of_the_publication(layout, last):
    section = measured_section(Results(read_results(RECORDS / "publication.json")), LAYOUTS[layout])
    headings = ("scene", "metric", "GNeRP" if last else "3DGS-DR")
    computed = [
        [
            scene,
            labels[0][0],
            *(" ".join(filter(None, (f"**{v}**" if bold else v, more))) for v, more, bold in cells),
        ]
        for scene, rows in section.blocks
        for labels, cells in rows
    ]
    assert [[*row.values()] for row in page_table("publication", *headings)] == computed


def recorded_speed():
    """Tables of the record of speeds: of the steps by recipe and scene, and of renderings."""
    lines = (ROOT / "benchmarks" / "records" / "speed.md").read_text(encoding="utf-8").splitlines()
    titles = [line.split(",", 1) for line in lines if " trained Gaussians, " in line]
    tables = tables_of(lines)
    parts = [{row["part"]: row for row in table} for table in tables[: len(titles)]]
    steps = {
        title: {"Gaussians": more.split(",", 1)[1].split(" trained")[0].strip(), **rows}
        for (title, more), rows in zip(titles, parts, strict=True)
    }
    return steps, [row for table in tables[len(titles) :] for row in table]


def test_speed_of_steps():
    steps, _ = recorded_speed()
    for row in page_table("speed", "recipe", "Gaussians"):
        recipe, _, scene = row["recipe"].partition(" on ")
        recorded = steps[f"{recipe.strip('`')} on {scene.strip('`') or 'spheres'}"]
        whole = recorded["whole step"]
        assert [*row.values()][1:] == [recorded["Gaussians"], whole["1 thread"], whole["2 threads"]]
    for row in page_table("speed", "part", "`spheres`"):
        scenes = (steps[f"polarguide-stokes on {scene}"] for scene in ("spheres", "car"))
        assert [*row.values()][1:] == [recorded[row["part"]]["1 thread"] for recorded in scenes]


def test_speed_of_rendering():
    _, recorded = recorded_speed()
    stated = page_table("speed", "scene", "recipe", "threads")
    assert [row for row in stated if row not in [{key: full[key] for key in row} for full in recorded]] == []


FIVE = ("psnr", "psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")


def test_five_values_of_the_publication():
    scenes = read_scenes([RECORDS / "publication.json"])
    for row in page_table("publication", "recipe", "`spheres`"):
        recipe, *cells, mean = row.values()
        computed = [
            [fmean(values(scenes[scene.strip("`")][recipe.strip("`")], of_run(key)).values()) for key in FIVE]
            for scene in [*row][1:-1]
        ]
        assert cells == [" / ".join(f"{value:.1f}" for value in of) for of in computed]
        assert mean == " / ".join(f"{fmean(of):.1f}" for of in zip(*computed, strict=True))


def test_normals_of_gnerp():
    scenes = read_scenes([RECORDS / f"gnerp{name}.json" for name in ("", "-car", "-water", "-circular")])
    table = table_of_page("reference/gnerp", "recipe", "`spheres`")
    for row in table:
        recipe = row.pop("recipe").strip("`")
        for scene, cell in row.items():
            rows = scenes[scene.strip("`")]
            found = values(rows.get(recipe, {}), of_run("normal_mae_deg")).values()
            assert cell == "".join(f"{value:.1f}°" for value in found)


def test_ablations():
    recipe = "polarguide-stokes"
    results = Results(read_results(RECORDS / f"ablation-{recipe}.json"))
    section = against_section(results)
    _, rows = section.blocks[-1]
    computed = {labels[0][0]: dict(zip(section.headings, cells, strict=True)) for labels, cells in rows}
    metrics = ("PSNR", "PSNR foreground", "normal error", "specular PSNR", "diffuse PSNR")
    lines = (ROOT / "docs" / "results" / "ablations.md").read_text(encoding="utf-8")
    (table,) = tables_of(lines.partition(f"\n## `{recipe}`\n")[2].partition("\n## ")[0].splitlines())
    for row in table[1:]:
        label = row.pop("row").split(" (")[0].strip("`")
        name = f"{recipe}{label}" if label.startswith(":") else label
        cells = {
            heading.split(" (")[0].split(" ↑")[0].split(" ↓")[0]: c for heading, c in computed[name].items()
        }
        assert [cells[metric][0] for metric in metrics] == list(row.values())
