"""From Gaussians to layers: what adds up to what, and what a mirror does."""

import math

import pytest
import torch
from reference_rasterizer import rasterize_reference
from torch import Tensor
from torch.nn.functional import normalize

from polarguide.gaussians.geometry import GRAZING, shortest_axis_normals
from polarguide.gaussians.harmonics import SH_C0, sh_basis
from polarguide.geometry.camera import Camera
from polarguide.raster import Rasterize, ScreenStatistic
from polarguide.raster.cpu import rasterize_cpu
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import MAXIMUM_LOG_LIGHT, PLAIN, Channels, base_colors, mirrored
from polarguide.shading.result import COLOR_CHANNELS

COUNT, RESOLUTION = 30, 8
LERP, FRESNEL = DeferredShading("lerp"), DeferredShading("fresnel")


def camera() -> Camera:
    eye, back = torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    return Camera(24, 20, 30.0, 30.0, 12.0, 10.0, eye, back)


@pytest.fixture
def gaussians() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return {
        "means": 0.7 * normal(COUNT, 3),
        "quaternions": normal(COUNT, 4),
        "log_scales": -1.5 + 0.5 * normal(COUNT, 3),
        "opacity_logits": normal(COUNT),
        "sh_dc": normal(COUNT, 3),
        "sh_rest": 0.1 * normal(COUNT, 15, 3),
        "strength_logits": normal(COUNT),
    }


def environment() -> Tensor:
    return torch.randn(6, RESOLUTION, RESOLUTION, 3, generator=torch.Generator().manual_seed(1))


def directions(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=-1)


def test_a_mirror_turns_back_what_meets_it_straight() -> None:
    rays = directions(0)
    torch.testing.assert_close(mirrored(rays, rays), -rays)
    torch.testing.assert_close(mirrored(rays, -rays), -rays)


def test_a_mirror_lets_pass_what_grazes_it() -> None:
    rays = directions(0)
    across = normalize(torch.linalg.cross(rays, directions(1)), dim=-1)
    torch.testing.assert_close(mirrored(rays, across), rays)


def test_angle_out_is_angle_in_and_twice_is_none() -> None:
    rays, normals = directions(0), directions(1)
    out = mirrored(rays, normals)
    torch.testing.assert_close(out.norm(dim=-1), torch.ones(40).double())
    torch.testing.assert_close((out * normals).sum(-1), -(rays * normals).sum(-1))
    torch.testing.assert_close(torch.linalg.cross(out, normals), torch.linalg.cross(rays, normals))
    torch.testing.assert_close(mirrored(out, normals), rays)


@pytest.mark.parametrize("shading", [LERP, FRESNEL], ids=["lerp", "fresnel"])
@pytest.mark.parametrize("rasterize", [rasterize_cpu, rasterize_reference], ids=["cpu", "reference"])
def test_layers_add_up_to_the_final_picture(
    gaussians: dict[str, Tensor], rasterize: Rasterize, shading: DeferredShading
) -> None:
    result = render(gaussians, camera(), rasterize, shading=shading, light={"texels": environment()})
    torch.testing.assert_close(result.specular + result.diffuse, result.final)
    strength = result.layers["strength"][..., None]
    assert 0 <= float(strength.min()) <= float(strength.max()) <= 1
    assert float(result.layers["reflection"].min()) >= 0
    if shading is LERP:
        torch.testing.assert_close(result.specular, strength * result.layers["reflection"])
        torch.testing.assert_close(result.diffuse, (1 - strength) * result.base)
        assert float(result.layers["reflection"].max()) <= 1
    else:
        assert torch.equal(result.diffuse, result.base)
        share = (result.specular / (strength * result.layers["reflection"]))[strength[..., 0] > 0.05]
        assert float(share.min()) > 0.0399, "Fresnel's reflectance of glass is 4 % at least"
        assert float(share.max()) <= 1.0001


def test_without_environment_there_is_no_reflection(gaussians: dict[str, Tensor]) -> None:
    result = render(gaussians, camera(), rasterize_cpu)
    assert result.layers.keys() == {"final", "base", "alpha", "normal"}
    assert torch.equal(result.final, result.base)
    assert "normal" not in render(gaussians, camera(), rasterize_cpu, RenderRequest(normals=False)).layers


def test_the_base_does_not_depend_on_what_else_is_splatted(gaussians: dict[str, Tensor]) -> None:
    plain = render(gaussians, camera(), rasterize_cpu, RenderRequest(normals=False))
    full = render(
        gaussians,
        camera(),
        rasterize_cpu,
        RenderRequest(depth=True),
        shading=LERP,
        light={"texels": environment()},
    )
    for name in ("base", "alpha"):
        torch.testing.assert_close(plain.layers[name], full.layers[name])
    torch.testing.assert_close(plain.training["radii"], full.training["radii"])


def test_strength_zero_shows_the_base_and_strength_one_the_mirror(gaussians: dict[str, Tensor]) -> None:
    base, normal = torch.rand(20, 24, 3), torch.randn(20, 24, 3)
    nothing, everything = torch.zeros(20, 24), torch.ones(20, 24)
    for shading in (LERP, FRESNEL):
        matte = shading.reflect(base, normal, nothing, environment(), camera())
        assert torch.equal(matte["final"], base)
    mirror = LERP.reflect(base, normal, everything, environment(), camera())
    assert torch.equal(mirror["final"], mirror["reflection"])


def test_a_dielectric_reflects_as_fresnel_says() -> None:
    """Straight on ((n - 1) / (n + 1))^2, at grazing all; at Brewster's angle half of what s reflects."""
    brewster = math.atan(1.5)
    cosines = torch.tensor([1.0, math.cos(brewster), 0.0])[:, None]
    black, one = torch.zeros(3, 3), torch.ones(3, 1)
    specular, diffuse = FRESNEL.contributions(black, one, torch.ones(3, 3), cosines)
    s_alone = math.sin(2 * brewster - math.pi / 2) ** 2
    torch.testing.assert_close(specular[:, 0], torch.tensor([0.04, s_alone / 2, 1.0]), atol=1e-5, rtol=1e-4)
    assert not diffuse.any()


def test_light_of_texels() -> None:
    raw = torch.tensor([-100.0, 0.0, 2.0, 100.0])
    torch.testing.assert_close(LERP.radiance(raw), torch.tensor([0.0, 0.5, 1 / (1 + math.exp(-2)), 1.0]))
    torch.testing.assert_close(
        FRESNEL.radiance(raw), torch.tensor([0.0, 1.0, math.exp(2), math.exp(MAXIMUM_LOG_LIGHT)])
    )


def test_a_mirror_facing_the_camera_shows_what_is_behind_it() -> None:
    """Light comes from -z alone: a mirror whose normal is -z shows it, one tilted up does not."""
    light = torch.full((6, RESOLUTION, RESOLUTION, 3), -20.0)
    light[5] = 20.0  # OpenGL's order: +x, -x, +y, -y, +z, -z
    size, strength = (20, 24, 3), torch.ones(20, 24)
    toward = torch.tensor([0.0, 0.0, -1.0]).expand(size)
    seen = LERP.reflect(torch.zeros(size), toward, strength, light, camera())["final"]
    assert float(seen.min()) > 0.99
    tilted = torch.tensor([0.0, -math.sin(math.pi / 4), -math.cos(math.pi / 4)]).expand(size)
    missed = LERP.reflect(torch.zeros(size), tilted, strength, light, camera())["final"]
    assert float(missed[10, 12].max()) < 0.01


def test_depth_of_one_gaussian_is_its_camera_depth(gaussians: dict[str, Tensor]) -> None:
    one = {name: t[:1].clone() for name, t in gaussians.items()}
    one["means"] = torch.tensor([[0.0, 0.1, 0.5]])
    one["log_scales"] = torch.zeros(1, 3)
    result = render(one, camera(), rasterize_cpu, RenderRequest(depth=True))
    torch.testing.assert_close(result.depth, torch.full((20, 24), 4.5), rtol=1e-5, atol=0)


def test_base_colors_are_never_negative_and_gray_without_harmonics(gaussians: dict[str, Tensor]) -> None:
    gaussians["sh_dc"] = gaussians["sh_dc"] * 5
    assert float(base_colors(gaussians, torch.zeros(3), 3).min()) == 0
    gaussians["sh_dc"] = 0 * gaussians["sh_dc"]
    gray = base_colors(gaussians, torch.zeros(3), 0)
    torch.testing.assert_close(gray, torch.full((COUNT, 3), 0.5))


def test_degree_zero_does_not_depend_on_the_direction(gaussians: dict[str, Tensor]) -> None:
    here, there = torch.zeros(3), torch.tensor([3.0, 1.0, -2.0])
    assert torch.equal(base_colors(gaussians, here, 0), base_colors(gaussians, there, 0))
    assert not torch.allclose(base_colors(gaussians, here, 3), base_colors(gaussians, there, 3), atol=1e-3)


@pytest.mark.parametrize("shading", [LERP, FRESNEL], ids=["lerp", "fresnel"])
@pytest.mark.parametrize("reflects", [False, True])
def test_every_parameter_that_shows_gets_a_finite_gradient(
    gaussians: dict[str, Tensor], reflects: bool, shading: DeferredShading
) -> None:
    trained = {name: t.clone().requires_grad_() for name, t in gaussians.items()}
    texels = environment().requires_grad_()
    statistic = ScreenStatistic(COLOR_CHANNELS)
    result = render(
        trained,
        camera(),
        rasterize_cpu,
        RenderRequest(statistic=statistic),
        shading=shading if reflects else PLAIN,
        light={"texels": texels},
    )
    loss = result.final.square().mean()
    loss.backward()
    shown = [name for name in trained if reflects or name != "strength_logits"]
    for name in shown:
        gradient = trained[name].grad
        assert gradient is not None, name
        assert bool(torch.isfinite(gradient).all()), name
        assert bool(gradient.any()), name
    assert (trained["strength_logits"].grad is not None) == reflects == (texels.grad is not None)
    assert statistic.gradient.shape == (COUNT, 2)


@pytest.mark.parametrize("shading", [LERP, FRESNEL], ids=["lerp", "fresnel"])
def test_native_and_reference_render_the_same_with_gradients(
    gaussians: dict[str, Tensor], shading: DeferredShading
) -> None:
    outcomes = []
    for rasterize, dtype in ((rasterize_cpu, torch.float32), (rasterize_reference, torch.float64)):
        trained = {name: t.to(dtype).detach().clone().requires_grad_() for name, t in gaussians.items()}
        texels = environment().to(dtype).detach().requires_grad_()
        result = render(
            trained, camera(), rasterize, RenderRequest(depth=True), shading=shading, light={"texels": texels}
        )
        result.final.square().mean().backward()
        outcomes.append((result, {name: t.grad for name, t in trained.items()}))
    (fast, fast_gradients), (slow, slow_gradients) = outcomes
    torch.testing.assert_close(fast.final.double(), slow.final, atol=1e-5, rtol=1e-4)
    seen = slow.alpha > 0.01
    torch.testing.assert_close(fast.depth.double()[seen], slow.depth[seen], atol=1e-4, rtol=1e-4)
    for name, expected in slow_gradients.items():
        found = fast_gradients[name]
        assert float((found.double() - expected).norm()) < 1e-3 * float(expected.norm()), name


LOCAL = DeferredShading("fresnel", local=True)


def test_local_light_that_is_nothing_changes_nothing(gaussians: dict[str, Tensor]) -> None:
    gaussians |= {"local_dc": torch.zeros(COUNT, 3), "local_rest": torch.zeros(COUNT, 15, 3)}
    without = render(
        gaussians, camera(), rasterize_reference, shading=FRESNEL, light={"texels": environment()}
    )
    with_it = render(gaussians, camera(), rasterize_reference, shading=LOCAL, light={"texels": environment()})
    torch.testing.assert_close(with_it.final, without.final)


def test_local_light_adds_to_the_environments_before_fresnel(gaussians: dict[str, Tensor]) -> None:
    """Of degree 0 it is a constant, blended by the weights that sum to alpha."""
    gaussians |= {"local_dc": torch.full((COUNT, 3), 0.5 / SH_C0), "local_rest": torch.zeros(COUNT, 15, 3)}
    without = render(
        gaussians, camera(), rasterize_reference, shading=FRESNEL, light={"texels": environment()}
    )
    with_it = render(gaussians, camera(), rasterize_reference, shading=LOCAL, light={"texels": environment()})
    torch.testing.assert_close(
        with_it.layers["reflection"], without.layers["reflection"] + 0.5 * without.alpha[..., None]
    )
    torch.testing.assert_close(with_it.base, without.base)


def test_local_light_is_that_of_the_mirrored_direction(gaussians: dict[str, Tensor]) -> None:
    generator = torch.Generator().manual_seed(3)
    gaussians |= {
        "local_dc": torch.randn(COUNT, 3, generator=generator),
        "local_rest": torch.randn(COUNT, 15, 3, generator=generator),
    }
    rays, normals = (directions(seed)[:COUNT].float() for seed in (4, 5))
    mirrors = mirrored(rays, normals)
    own = Channels(light_dc=gaussians["local_dc"], light_rest=gaussians["local_rest"])
    light = own.values(gaussians | {"means": rays}, normals, torch.zeros(3), 3)["local"]
    basis = sh_basis(mirrors, 3)
    coefficients = torch.cat((gaussians["local_dc"][:, None], gaussians["local_rest"]), dim=1)
    torch.testing.assert_close(light, (basis[..., None] * coefficients).sum(1), atol=1e-5, rtol=1e-5)


def test_normals_keep_their_outer_side_past_the_silhouette(gaussians: dict[str, Tensor]) -> None:
    """A Gaussian that faces slightly away is turned over without its outer side, and stays with it."""
    center = camera().center.float()
    gaussians["outward"] = torch.zeros(COUNT, 3)
    shape = (gaussians["means"], gaussians["quaternions"], gaussians["log_scales"], center)
    flipped = shortest_axis_normals(*shape)
    torch.testing.assert_close(shortest_axis_normals(*shape, gaussians["outward"]), flipped)
    cosine = (flipped * normalize(center - gaussians["means"], dim=-1)).sum(-1)
    outward = -flipped
    kept = shortest_axis_normals(*shape, outward)
    grazing = cosine < GRAZING
    assert 3 < int(grazing.sum()) < COUNT
    torch.testing.assert_close(kept[grazing], -flipped[grazing])
    torch.testing.assert_close(kept[~grazing], flipped[~grazing])
    gaussians["outward"] = outward
    normal = render(
        gaussians, camera(), rasterize_reference, shading=FRESNEL, light={"texels": environment()}
    ).normal
    del gaussians["outward"]
    other = render(
        gaussians, camera(), rasterize_reference, shading=FRESNEL, light={"texels": environment()}
    ).normal
    assert not torch.allclose(normal, other)


@pytest.mark.parametrize("shading", [LERP, FRESNEL], ids=["lerp", "fresnel"])
def test_held_layers_are_the_layers_and_leave_rotations_alone(
    gaussians: dict[str, Tensor], shading: DeferredShading
) -> None:
    leaves = {name: values.clone().requires_grad_() for name, values in gaussians.items()}
    texels = environment().requires_grad_()
    result = render(
        leaves,
        camera(),
        rasterize_cpu,
        RenderRequest(layers_detached=True, depth=True),
        shading=shading,
        light={"texels": texels},
    )
    assert torch.equal(result.training["detached_specular"], result.specular)
    assert torch.equal(result.training["detached_diffuse"], result.diffuse)

    def gradients(layer: Tensor) -> dict[str, Tensor]:
        wanted = [leaves["strength_logits"], leaves["sh_dc"], texels, leaves["quaternions"]]
        found = torch.autograd.grad(layer.square().sum(), wanted, retain_graph=True, materialize_grads=True)
        return dict(zip(("strength", "base", "texels", "quaternions"), found, strict=True))

    moved, held = gradients(result.specular), gradients(result.training["detached_specular"])
    for name in ("strength", "base", "texels"):
        torch.testing.assert_close(held[name], moved[name])
    # Rotations shape the splats, too, so that what is left of their gradient is not zero: it is that of a picture whose
    # normals are given.
    assert float((held["quaternions"] - moved["quaternions"]).abs().max()) > 1e-4
    frozen = {**leaves, "quaternions": leaves["quaternions"].detach()}
    still = render(
        frozen, camera(), rasterize_cpu, RenderRequest(depth=True), shading=shading, light={"texels": texels}
    )
    assert torch.equal(still.specular, result.training["detached_specular"])


def test_layers_are_held_only_where_asked_for(gaussians: dict[str, Tensor]) -> None:
    light = {"texels": environment()}
    assert render(gaussians, camera(), rasterize_cpu, shading=FRESNEL, light=light).training.keys() == {
        "radii"
    }
    plain = render(gaussians, camera(), rasterize_cpu, RenderRequest(layers_detached=True), shading=PLAIN)
    assert plain.training.keys() == {"radii"}


@pytest.mark.parametrize("index", [1.0, 0.5, float("nan")])
def test_a_refractive_index_is_more_than_one(index: float) -> None:
    with pytest.raises(ValueError, match=f"expected more than 1, found {index}"):
        DeferredShading("fresnel", refractive_index=index)
