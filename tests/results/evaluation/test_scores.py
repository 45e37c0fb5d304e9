"""Scores of one view and the record of a run."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from faults import Fault

from polarguide.results.evaluation import evaluate, metrics, scores, table
from polarguide.results.evaluation.table import HIGHEST_PSNR, VIEW_METRICS
from polarguide.results.evaluation.target import ViewTarget
from polarguide.shading.result import RenderResult

VIEW_KEYS = {metric.key for metric in VIEW_METRICS}
AGAINST_GROUND_TRUTH = (
    "psnr_foreground",
    "psnr_reflective",
    "normal_mae_deg",
    "normal_within_11",
    "specular_psnr",
    "diffuse_psnr",
    "specular_psnr_aligned",
    "diffuse_psnr_aligned",
)

PROVENANCE = {
    "recipe": "polarguide",
    "seed": 0,
    "commit": "0123abc",
    "versions": {"torch": "2.13.0"},
    "device": "cpu",
    "downscale": 1,
    "scene_hash": "ff00",
}


def rand(seed, *shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def score(photograph, invalid, ground_truth, rendered):
    target = ViewTarget.of(photograph, invalid, ground_truth, torch.device("cpu"))
    return scores.score_view(target, rendered)


def scene(seed=0, height=36, width=40):
    specular, diffuse = rand(seed, height, width, 3) * 0.5, rand(seed + 1, height, width, 3) * 0.5
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[5:30, 5:30] = True
    normal = torch.nn.functional.normalize(rand(seed + 2, height, width, 3) - 0.5, dim=-1)
    normal[8:11, 8:11] = 0  # foreground without a true normal
    ground_truth = SimpleNamespace(normal=normal, mask=mask, specular=specular, diffuse=diffuse)
    return (specular + diffuse) / 2, ground_truth


def rendering(photograph, ground_truth):
    return RenderResult(
        {
            "final": photograph * 0.9,
            "normal": ground_truth.normal * 0.3 + 0.02,
            "specular": ground_truth.specular * 0.4,
            "diffuse": ground_truth.diffuse * 0.5,
        }
    )


def test_every_key_has_its_definition():
    photograph, ground_truth = scene()
    rendered = rendering(photograph, ground_truth)
    got = score(photograph, None, ground_truth, rendered)
    reflective = metrics.reflective_mask(ground_truth.specular, 2 * photograph, ground_truth.mask)
    assert 0 < reflective.sum() < ground_truth.mask.sum()
    expected = {
        "psnr": metrics.psnr(rendered.final, photograph),
        "psnr_foreground": metrics.psnr(rendered.final, photograph, ground_truth.mask),
        "psnr_reflective": metrics.psnr(rendered.final, photograph, reflective),
        "ssim": float(metrics.ssim(rendered.final, photograph)),
        "normal_mae_deg": float(
            metrics.normal_mae_deg(rendered.normal, ground_truth.normal, ground_truth.mask)
        ),
        "normal_within_11": float(
            metrics.normal_within_11(rendered.normal, ground_truth.normal, ground_truth.mask)
        ),
        "specular_psnr": metrics.decibels(
            float(metrics.layer_error(rendered.specular, ground_truth.specular, ground_truth.mask))
        ),
        "specular_psnr_aligned": HIGHEST_PSNR,
        "diffuse_psnr": HIGHEST_PSNR,
        "diffuse_psnr_aligned": HIGHEST_PSNR,
    }
    assert {key: got[key] for key in expected} == pytest.approx(expected)
    assert set(got) == {*VIEW_KEYS, "lpips_reason", "stokes_error_reason"}
    assert len({round(expected[key], 6) for key in list(expected)[:7]}) == 7


def test_invalid_pixels_count_in_no_score():
    photograph, ground_truth = scene()
    rendered = rendering(photograph, ground_truth)
    invalid = torch.zeros(photograph.shape[:2], dtype=torch.bool)
    invalid[8:20, 12:22] = True
    before = score(photograph, invalid, ground_truth, rendered)
    assert before != score(photograph, None, ground_truth, rendered)
    spoiled = RenderResult({k: torch.where(invalid[..., None], 0.3, v) for k, v in rendered.layers.items()})
    photograph = torch.where(invalid[..., None], 1.0, photograph)
    assert score(photograph, invalid, ground_truth, spoiled) == before


def test_what_is_missing_is_none():
    photograph, ground_truth = scene()
    plain = RenderResult({"final": photograph * 0.9})
    without_ground_truth = score(photograph, None, None, plain)
    assert without_ground_truth["psnr"] is not None
    for key in AGAINST_GROUND_TRUTH:
        assert without_ground_truth[key] is None
    without_layers = score(photograph, None, ground_truth, plain)
    assert without_layers["psnr_reflective"] is not None
    for key in ("normal_mae_deg", "normal_within_11", "specular_psnr", "diffuse_psnr_aligned"):
        assert without_layers[key] is None
    ground_truth.mask = torch.zeros_like(ground_truth.mask)
    assert (
        score(photograph, None, ground_truth, rendering(photograph, ground_truth))["psnr_foreground"] is None
    )


def test_broken_pixels_are_scored_and_counted():
    photograph, ground_truth = scene()
    rendered = rendering(photograph, ground_truth)
    rendered.final[10, 10, 1] = math.nan
    rendered.specular[10, 10] = math.inf
    rendered.normal[7, 7, 0] = math.nan
    got = score(photograph, None, ground_truth, rendered)
    assert got["nonfinite_pixels"] == 2
    rendered.final[10, 10] = 0
    rendered.specular[10, 10] = 0
    rendered.normal[7, 7] = 0
    clean = score(photograph, None, ground_truth, rendered)
    assert "nonfinite_pixels" not in clean
    assert {k: v for k, v in got.items() if k != "nonfinite_pixels"} == clean


def test_summary_is_the_plain_mean_of_what_is_there():
    unknown = {"psnr_reflective": None, "lpips": None, "lpips_reason": "no network"}
    means = scores.summarize(
        {
            "a": {**unknown, "psnr": 20.0, "ssim": 0.5},
            "b": {**unknown, "psnr": 30.0, "ssim": 0.7, "psnr_reflective": 18.0},
            "c": {**unknown, "psnr": 40.0, "ssim": math.nan},
        }
    )
    assert means["psnr"] == 30
    assert means["ssim"] == pytest.approx(0.6)
    assert means["psnr_reflective"] == 18
    assert means["normal_mae_deg"] is None
    assert means["lpips_reason"] == "no network"


@pytest.fixture
def views():
    photograph, ground_truth = scene()
    perfect = rendering(photograph, ground_truth)
    perfect.layers["final"] = photograph
    return {
        "v1": score(photograph, None, ground_truth, rendering(photograph, ground_truth)),
        "v2": score(photograph, None, ground_truth, perfect),
    }


def test_metrics_file(tmp_path, views):
    path = tmp_path / "metrics.json"
    path.write_text("old")
    run = {"fps": 12.5, "gaussians": 1000, "train_seconds": math.nan}
    written = evaluate.write_metrics(path, views=views, run=run, provenance=PROVENANCE)

    def refuse(token):
        raise AssertionError(f"{token} is not JSON")

    read = json.loads(path.read_text(), parse_constant=refuse)
    assert read == written
    assert read["views"]["v2"]["psnr"] == 100
    assert read["psnr"] == pytest.approx((views["v1"]["psnr"] + 100) / 2)
    assert (read["fps"], read["gaussians"], read["train_seconds"], read["steps"]) == (12.5, 1000, None, None)
    assert read["provenance"] == PROVENANCE
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]
    evaluate.validate_metrics(read)


ERRORS = {
    "pixels": 12,
    "views": 2,
    "psnr": 30.0,
    "normal_mae_deg": 4.5,
    "specular_psnr": None,
    "diffuse_psnr": 20.0,
    "stokes_error": 0.5,
}


def test_errors_by_object_are_part_of_the_record(tmp_path, views):
    objects, materials = {"cup": {"material": "dielectric", **ERRORS}}, {"dielectric": ERRORS}
    given = {"views": views, "run": {}, "provenance": PROVENANCE}
    evaluate.write_metrics(tmp_path / "metrics.json", **given, objects=objects, materials=materials)
    read = evaluate.read_metrics(tmp_path)
    assert (read["objects"], read["materials"]) == (objects, materials)
    evaluate.write_metrics(tmp_path / "metrics.json", **given)
    assert evaluate.read_metrics(tmp_path)["objects"] == {}
    wrong = {"cup": {key: value for key, value in objects["cup"].items() if key != "stokes_error"}}
    path, materials = tmp_path / "metrics.json", {"metal": {**ERRORS, "psnr": "x"}}
    Fault(expected="the field stokes_error").raised_by(evaluate.write_metrics, path, **given, objects=wrong)
    Fault("psnr)", "a number or null", '"x"').raised_by(
        evaluate.write_metrics, path, **given, materials=materials
    )


def test_failed_write_leaves_the_old_file(tmp_path, views):
    path = tmp_path / "metrics.json"
    path.write_text("old")
    with pytest.raises(TypeError):
        evaluate.write_metrics(path, views=views, run={}, provenance={**PROVENANCE, "note": object()})
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def set_at(tree, path, value):
    *parents, last = path
    for key in parents:
        tree = tree[key]
    if value is KeyError:
        del tree[last]
    else:
        tree[last] = value


@pytest.mark.parametrize(
    ("path", "value", "place", "expected", "found"),
    [
        (("psnr",), KeyError, "m.json", "the field psnr", ""),
        (("psnr",), math.inf, "m.json (psnr)", "100", "Infinity"),
        (("psnr",), 101.0, "m.json (psnr)", "100", "101.0"),
        (("fps",), "fast", "m.json (fps)", "a number or null", '"fast"'),
        (("fps",), math.nan, "m.json (fps)", "a finite number", "nan"),
        (("steps",), True, "m.json (steps)", "a number or null", "true"),
        (("views",), {}, "m.json (views)", "length >= 1", "{}"),
        (("views", "v1"), 3, "m.json, view v1", "a JSON object", "3"),
        (("views", "v2", "ssim"), KeyError, "m.json, view v2", "the field ssim", ""),
        (("views", "v2", "ssim"), "x", "m.json, view v2 (ssim)", "a number or null", '"x"'),
        (("views", "v2", "lpips_reason"), None, "m.json, view v2 (lpips_reason)", "a reason", "null"),
        (("lpips_reason",), None, "m.json (lpips_reason)", "a reason", "null"),
        (("provenance", "seed"), KeyError, "m.json (provenance)", "the field seed", ""),
        (("provenance",), None, "m.json (provenance)", "a JSON object", "null"),
    ],
)
def test_schema_names_what_is_wrong(tmp_path, views, path, value, place, expected, found):
    for scored in views.values():
        scored.update(lpips=None, lpips_reason="not wanted here")
    good = evaluate.write_metrics(tmp_path / "metrics.json", views=views, run={}, provenance=dict(PROVENANCE))
    set_at(good, path, value)
    Fault(place, expected, found).raised_by(evaluate.validate_metrics, good, "m.json")


def test_a_record_is_read_from_its_run(tmp_path, views):
    Fault("metrics.json", "the scores of a run", "none").raised_by(evaluate.read_metrics, tmp_path)
    written = evaluate.write_metrics(tmp_path / "metrics.json", views=views, run={}, provenance=PROVENANCE)
    assert evaluate.read_metrics(tmp_path) == written
    (tmp_path / "metrics.json").write_text(json.dumps(written | {"fps": math.nan}))
    Fault("metrics.json (fps)", "finite").raised_by(evaluate.read_metrics, tmp_path)


def test_worst_views_have_the_lowest_psnr_and_the_most_haze(views):
    haze = {"v1": 0.01, "v2": 0.03, "v3": None}
    views["v3"] = views["v1"] | {"psnr": 11.0}
    scored = {name: view | {"haze_free": haze[name]} for name, view in views.items()}
    shown = dict(table.shown_metrics(scores.summarize(scored) | {"views": scored}))
    assert shown["PSNR, worst view"] == "11.000 dB (v3)"
    assert shown["haze, worst view"] == "3.000 % (v2)"
    assert shown["haze"] == "2.000 %"


def test_shown_metrics_are_those_of_the_tables(views):
    means = scores.summarize(views) | {"fps": 12.5, "gaussians": 1000, "normal_within_11": 0.25}
    means |= {"train_seconds_reason": "the log is gone", "depth_error_median_percent": None}
    lines = table.shown_metrics(means)
    hidden = table.absent_metrics(means)
    unseen = ["PSNR seen", "seen pixels", "SSIM seen", "Stokes error seen"]
    assert hidden == [*unseen, "depth error", "haze", "mesh F-score 1 %"]
    assert [label for label, _ in lines] == [
        m.label for m in table.METRICS if m.shown == "tables" and m.label not in hidden
    ]
    shown = dict(lines)
    assert shown["PSNR"] == f"{means['psnr']:.3f} dB"
    assert shown["normals within 11.25 deg"] == "25.000 %"
    assert (shown["Gaussians"], shown["training"]) == ("1,000", "n/a (the log is gone)")
    lacking = means | {"lpips": None, "lpips_reason": "not installed: its weights are missing"}
    assert dict(table.shown_metrics(lacking))["LPIPS"] == "n/a (not installed)"
    assert table.explained(lacking) == ["LPIPS: its weights are missing"]
    assert shown["FLIP"] == f"{means['flip']:.3f}"
    only_scores = dict(table.shown_metrics(means | {"ssim": None}, scores_only=True))
    assert not {"SSIM", "Gaussians", "FPS", "specular PSNR aligned"} & set(only_scores)
    assert only_scores["PSNR"] == shown["PSNR"]
