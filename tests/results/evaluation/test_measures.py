"""Polarization, depth and coverage scores against loops over pixels."""

import dataclasses
import math
import statistics

import numpy as np
import pytest
import torch
from known_scene import HEIGHT, WIDTH, known_scene, rendered

from polarguide.capture.exposures import Exposure
from polarguide.capture.variants import black_pixels
from polarguide.results.evaluation.scores import score_view, summarize
from polarguide.results.evaluation.target import SceneFacts, ViewTarget, without_jumps

CPU = torch.device("cpu")
SCENE = known_scene()
VIEW, FACTS = SCENE.views[0], SceneFacts.of(SCENE)
PIXELS = [(y, x) for y in range(HEIGHT) for x in range(WIDTH)]


def score(view, facts, *, seed=5, stokes="predicted"):
    result, predicted, in_front = rendered(view, seed)
    given = predicted if stokes == "predicted" else stokes
    target = ViewTarget.of_view(view, facts, CPU)
    return score_view(target, result, stokes=given, in_front=in_front)


def stokes_by_loop(view, predicted, counts):
    """Sum of |error| over sum of |measured|, pixel by pixel, from the four intensities."""
    four = view.codes.numpy().astype(np.float64) / 65535
    error = size = 0.0
    for y, x in PIXELS:
        if counts[y, x]:
            for channel in range(3):
                i0, i45, i90, i135 = four[:, y, x, channel]
                for component, true in ((1, i0 - i90), (2, i45 - i135)):
                    error += abs(float(predicted[component, y, x, channel]) - true)
                    size += abs(true)
    return error / size


def test_stokes_error_over_the_foreground():
    _, predicted, _ = rendered(VIEW, 5)
    counts = VIEW.ground_truth.mask & ~VIEW.invalid & ~VIEW.saturated
    expected = stokes_by_loop(VIEW, predicted, counts)
    assert score(VIEW, FACTS)["stokes_error"] == pytest.approx(expected, rel=1e-6)
    assert "stokes_error_reason" not in score(VIEW, FACTS)
    for clipped in (VIEW.invalid, VIEW.saturated):
        assert stokes_by_loop(VIEW, predicted, counts | (VIEW.ground_truth.mask & clipped)) != pytest.approx(
            expected
        )


def test_scores_of_seen_pixels_are_those_of_a_view_without_the_others():
    result, predicted, _ = rendered(VIEW, 5)
    seen = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    seen[:, 5:11] = False
    scores = score_view(ViewTarget.of_view(VIEW, FACTS, CPU).with_coverage(seen), result, stokes=predicted)
    smaller = dataclasses.replace(VIEW, invalid=VIEW.invalid | ~seen)
    expected = score_view(ViewTarget.of_view(smaller, FACTS, CPU), result, stokes=predicted)
    for key in ("psnr", "ssim", "stokes_error"):
        assert scores[f"{key}_seen"] == pytest.approx(expected[key], rel=1e-9), key
        assert scores[f"{key}_seen"] != pytest.approx(scores[key], rel=1e-6), key
    valid = ~VIEW.invalid
    assert scores["seen_share"] == pytest.approx(float((seen & valid).sum() / valid.sum()))


def test_stokes_error_of_no_prediction_and_of_the_truth():
    four = VIEW.intensities()
    truth = torch.stack((four.sum(0) / 2, four[0] - four[2], four[1] - four[3]))
    assert score(VIEW, FACTS, stokes=truth)["stokes_error"] == pytest.approx(0, abs=1e-6)
    assert score(VIEW, FACTS, stokes=torch.zeros_like(truth))["stokes_error"] == 1
    assert score(VIEW, FACTS, stokes=-truth)["stokes_error"] == pytest.approx(2)
    # What is predicted of S0 does not count.
    truth[0] = 7
    assert score(VIEW, FACTS, stokes=truth)["stokes_error"] == pytest.approx(0, abs=1e-6)


def without(view, **fields):
    truth = dataclasses.replace(view.ground_truth, **fields)
    return dataclasses.replace(view, truth=truth)


@pytest.mark.parametrize("masked", [False, True])
def test_stokes_error_without_true_masks_is_over_the_whole_picture_or_the_users_mask(masked):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[2:9, 5:20] = True
    views = [dataclasses.replace(view, truth=None, mask=mask if masked else None) for view in SCENE.views]
    facts = SceneFacts.of(dataclasses.replace(SCENE, views=tuple(views)))
    result, predicted, _ = rendered(VIEW, 5)
    got = score_view(ViewTarget.of_view(views[0], facts, CPU), result, stokes=predicted)
    counts = ~VIEW.invalid & ~VIEW.saturated & (mask if masked else True)
    assert got["stokes_error"] == pytest.approx(stokes_by_loop(views[0], predicted, counts), rel=1e-6)
    for key in (
        "depth_error_median_percent",
        "haze_true",
        "depth_beyond",
        "coverage_error",
        "alpha_outside",
        "specular_psnr_dielectric",
        "psnr_foreground",
    ):
        assert got[key] is None


def test_stokes_error_without_layers_or_polarization():
    got = score(VIEW, FACTS, stokes=None)
    assert got["stokes_error"] is None
    assert "no specular and diffuse layers" in got["stokes_error_reason"]
    codes = VIEW.codes.to(torch.float64).mean(dim=0, keepdim=True).expand(4, -1, -1, -1)
    depolarized = dataclasses.replace(VIEW, pictures=codes.round().to(torch.uint16))
    got = score(depolarized, FACTS)
    assert got["stokes_error"] is None
    assert "negligible" in got["stokes_error_reason"]
    pair = dataclasses.replace(VIEW, pictures=VIEW.codes[[0, 2]], exposures=(Exposure(0.0), Exposure(90.0)))
    got = score(pair, FACTS)
    assert got["stokes_error"] is None
    assert "do not determine" in got["stokes_error_reason"]
    # S1 of a thousandth of S0 is just enough to be compared with.
    for share, known in ((0.9e-3, False), (1.1e-3, True)):
        half = VIEW.intensities().mean(dim=0)
        four = torch.stack((half * (1 + share), half, half * (1 - share), half))
        weak = dataclasses.replace(VIEW, pictures=(four * 65535).round().to(torch.uint16))
        measured = weak.codes.double() / 65535
        counts = VIEW.ground_truth.mask & ~VIEW.invalid & ~VIEW.saturated
        size = (measured[0] - measured[2]).abs()[counts].sum() + (measured[1] - measured[3]).abs()[
            counts
        ].sum()
        assert bool(size >= 1e-3 * measured.sum(0)[counts].sum() / 2) == known
        assert (score(weak, FACTS)["stokes_error"] is not None) == known
    means = summarize({"a": got, "b": score(VIEW, FACTS)})
    assert means["stokes_error"] == score(VIEW, FACTS)["stokes_error"]
    assert means.get("stokes_error_reason") is None
    assert summarize({"a": got})["stokes_error_reason"] == got["stokes_error_reason"]


def test_depth_error_is_the_median_over_the_foreground():
    view = SCENE.views[1]
    result, *_ = rendered(view, 5)
    a, b = (v.camera.center.numpy() for v in SCENE.views)
    assert FACTS.extent == pytest.approx(1.1 * np.linalg.norm(a - b))
    known = view.ground_truth
    for scored, mask in ((view, known.mask), (without(view, mask=None), torch.ones_like(known.mask))):
        errors = [
            abs(float(result.depth[p]) - float(known.depth[p]))
            for p in PIXELS
            if mask[p] and not view.invalid[p] and known.depth[p] > 0
        ]
        expected = 100 * statistics.median(errors) / FACTS.extent
        assert score(scored, FACTS)["depth_error_median_percent"] == pytest.approx(expected, rel=1e-5)


def test_haze_is_the_mean_alpha_in_front_of_the_surface():
    *_, in_front = rendered(VIEW, 5)
    smooth = without_jumps(VIEW.ground_truth.depth) & ~VIEW.invalid
    counted = [float(in_front[p]) for p in PIXELS if smooth[p]]
    assert 0 < len(counted) < len(PIXELS)
    assert score(VIEW, FACTS)["haze_true"] == pytest.approx(statistics.mean(counted))
    assert score(VIEW, FACTS)["haze_free"] is None


def test_haze_in_free_space_is_the_mean_over_pixels_with_a_confirmed_surface():
    result, _, in_front = rendered(VIEW, 5)
    confirmed = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    confirmed[:, 3:9] = True
    counted = [float(in_front[p]) for p in PIXELS if confirmed[p] and not VIEW.invalid[p]]
    target = ViewTarget.of_view(VIEW, FACTS, CPU)
    seen = torch.ones_like(confirmed)
    scores = score_view(target.with_coverage(seen, confirmed), result, in_free_space=in_front)
    assert scores["haze_free"] == pytest.approx(statistics.mean(counted))
    nowhere = target.with_coverage(seen, torch.zeros_like(confirmed))
    assert score_view(nowhere, result, in_free_space=in_front)["haze_free"] is None


def test_depth_beyond_counts_what_is_drawn_from_behind_the_surface():
    result, *_ = rendered(VIEW, 5)
    true = VIEW.ground_truth.depth
    factor = torch.tensor(np.random.default_rng(6).uniform(0.5, 2.0, (HEIGHT, WIDTH)), dtype=true.dtype)
    factor[3:5] = 1.2499
    factor[7:9] = 1.2501
    factor[:, 3] = 0.0  # nothing covers these
    result.layers["depth"] = factor * true
    smooth = without_jumps(true) & ~VIEW.invalid
    counted = [float(factor[p]) > 1.25 or float(factor[p]) == 0.0 for p in PIXELS if smooth[p]]
    assert 0 < sum(counted) < len(counted)
    got = score_view(ViewTarget.of_view(VIEW, FACTS, CPU), result)["depth_beyond"]
    assert got == pytest.approx(sum(counted) / len(counted))


def test_jumps_of_depth():
    rng = np.random.default_rng(3)
    depth = 2 + 0.02 * rng.uniform(size=(HEIGHT, WIDTH))
    depth[:6, :9] = 3.0  # a jump to something farther
    depth[14:, 20:] = 0.0  # nothing
    depth[10, 4] = 2.15  # a pixel by itself
    expected = np.zeros((HEIGHT, WIDTH), bool)
    for y, x in PIXELS:
        jumps = False
        for v in range(max(0, y - 1), min(HEIGHT, y + 2)):
            for u in range(max(0, x - 1), min(WIDTH, x + 2)):
                square = depth[max(0, v - 1) : v + 2, max(0, u - 1) : u + 2]
                jumps |= square.min() == 0 or square.max() > 1.05 * square.min()
        expected[y, x] = depth[y, x] > 0 and not jumps
    np.testing.assert_array_equal(without_jumps(torch.from_numpy(depth)).numpy(), expected)
    assert expected[0, :7].all(), "the border of the picture is no jump"


def on_black(view):
    """The view with light inside its mask alone."""
    codes = torch.where(view.ground_truth.mask[None, ..., None], view.codes.int(), 0).to(torch.uint16)
    return dataclasses.replace(view, pictures=codes)


def test_coverage_of_an_object_on_black():
    dark = dataclasses.replace(SCENE, views=tuple(on_black(view) for view in SCENE.views))
    facts = SceneFacts.of(dark)
    assert facts.object_only
    view = dark.views[0]
    result, *_ = rendered(view, 5)
    mask = view.ground_truth.mask
    valid = [p for p in PIXELS if not view.invalid[p]]
    expected = sum(abs(float(result.alpha[p]) - float(mask[p])) for p in valid) / len(valid)
    got = score(view, facts)
    assert got["coverage_error"] == pytest.approx(expected, rel=1e-6)
    beyond = [(y, x) for y, x in valid if not mask[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4].any()]
    assert 0 < len(beyond) < len(valid)
    expected = sum(float(result.alpha[p]) for p in beyond) / len(beyond)
    assert got["alpha_outside"] == pytest.approx(expected, rel=1e-6)


def test_noise_before_nothing_is_black_to_every_measure():

    def noisy(view):
        faint = torch.randint(0, 600, view.codes.shape, generator=torch.Generator().manual_seed(0))
        codes = torch.where(view.ground_truth.mask[None, ..., None], view.codes.int(), faint)
        return dataclasses.replace(view, pictures=codes.to(torch.uint16))

    dark = dataclasses.replace(SCENE, views=tuple(noisy(view) for view in SCENE.views))
    brightest = dark.views[0].photograph().amax(dim=-1)[~dark.views[0].ground_truth.mask]
    assert float((brightest > 1 / 255).float().mean()) > 0.3
    assert SceneFacts.of(dark).object_only
    share = float((~VIEW.ground_truth.mask).float().mean())
    assert float(black_pixels(dark.views[0]).float().mean()) == pytest.approx(share, abs=0.2)


def test_coverage_is_not_scored_where_there_is_a_background():
    assert not FACTS.object_only
    got = score(VIEW, FACTS)
    assert (got["coverage_error"], got["alpha_outside"]) == (None, None)
    # One view with a background is enough.
    assert not SceneFacts.of(dataclasses.replace(SCENE, views=(on_black(VIEW), SCENE.views[1]))).object_only


def test_holes_are_not_free():
    result, stokes, in_front = rendered(VIEW, 5)
    result.depth[:] = math.nan
    target = ViewTarget.of_view(VIEW, FACTS, CPU)
    got = score_view(target, result, stokes=torch.full_like(stokes, math.nan), in_front=in_front)
    assert got["stokes_error"] == 1, "a prediction that is no number counts as none"
    counts = VIEW.ground_truth.mask & ~VIEW.invalid & (VIEW.ground_truth.depth > 0)
    median = float(VIEW.ground_truth.depth[counts].double().quantile(0.5))
    assert got["depth_error_median_percent"] == pytest.approx(100 * median / FACTS.extent, rel=1e-6)
    assert got["nonfinite_pixels"] == HEIGHT * WIDTH


def test_layers_without_metals():
    result, *_ = rendered(VIEW, 5)
    squares = []
    for p in PIXELS:
        if int(VIEW.ground_truth.object_ids[p]) in (2, 4, 7) and not VIEW.invalid[p]:
            for a, b in zip(result.specular[p], VIEW.ground_truth.specular[p] / 2, strict=True):
                shown = [
                    12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055
                    for v in (min(max(float(c), 0.0), 1.0) for c in (a, b))
                ]
                squares.append((shown[0] - shown[1]) ** 2)
    expected = -10 * math.log10(sum(squares) / len(squares))
    got = score(VIEW, FACTS)
    assert got["specular_psnr_dielectric"] == pytest.approx(expected, abs=1e-5)
    assert got["specular_psnr_dielectric"] != pytest.approx(got["specular_psnr"], abs=1e-4)
    unnumbered = without(VIEW, object_ids=None)
    assert score(unnumbered, FACTS)["specular_psnr_dielectric"] is None
