"""The native kernels (``native/``). Arrays are float32, contiguous, on the CPU."""

from collections.abc import Sequence

from torch import Tensor

MAX_CHANNELS: int

def thread_count() -> int: ...
def set_thread_count(threads: int) -> None: ...
def simd() -> str: ...
def select_simd(name: str) -> None: ...
def first_not_finite(array: Tensor) -> int: ...
def fma_peak(seconds: float = 0.5) -> float: ...

class Rasterizer:
    def __init__(
        self,
        rotation: Sequence[float],
        translation: Sequence[float],
        intrinsics: Sequence[float],
        width: int,
        height: int,
        near_plane: float,
        permutation: Sequence[int],
        statistic_channels: int,
    ) -> None: ...
    def forward(
        self,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        out: Tensor,
        alpha: Tensor,
        radius: Tensor,
        count_pairs: bool = False,
        for_backward: bool = True,
    ) -> None: ...
    def surface(
        self,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        width: float,
        out: Tensor,
    ) -> None: ...
    def backward(
        self,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        out: Tensor,
        grad_out: Tensor,
        grad_alpha: Tensor,
        d_means: Tensor,
        d_quaternions: Tensor,
        d_scales: Tensor,
        d_opacities: Tensor,
        d_features: Tensor,
        statistic: Tensor | None,
        still: Sequence[int] = ...,
        grad_still: Tensor | None = None,
    ) -> None: ...
    @property
    def pairs(self) -> int: ...
    @property
    def instances(self) -> int: ...

class Splatting:
    def __init__(
        self,
        means: Tensor,
        quaternions: Tensor,
        log_scales: Tensor,
        opacity_logits: Tensor,
        dc: Tensor,
        rest: Tensor,
        degree: int,
        center: Tensor,
        forward: Tensor | None,
        normals: bool,
        grazing: float,
        outward: Tensor | None,
        strength: Tensor | None,
        light_dc: Tensor | None,
        light_rest: Tensor | None,
        metalness: Tensor | None,
        further: Tensor | None,
    ) -> None: ...
    @property
    def channels(self) -> int: ...
    def forward(
        self, scales: Tensor, opacities: Tensor, features: Tensor, mirrored: Tensor | None
    ) -> None: ...
    def backward(
        self,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        mirrored: Tensor | None,
        grad_means: Tensor,
        grad_quaternions: Tensor,
        grad_scales: Tensor,
        grad_opacities: Tensor,
        grad_features: Tensor,
        to_means: Tensor,
        to_quaternions: Tensor,
        to_log_scales: Tensor,
        to_opacity_logits: Tensor,
        to_dc: Tensor,
        to_rest: Tensor,
        to_strength: Tensor | None,
        to_light_dc: Tensor | None,
        to_light_rest: Tensor | None,
        to_further: Tensor | None,
    ) -> None: ...

def shortest_sum(log_scales: Tensor, radii: Tensor) -> tuple[float, float]: ...
def shortest_gradient(log_scales: Tensor, radii: Tensor, factor: float, gradient: Tensor) -> None: ...
def photometric(
    prediction: Tensor,
    target: Tensor,
    weight: Tensor | None,
    weight_sum: float,
    ssim_weight: float,
    gradient: Tensor | None,
) -> tuple[float, float, float]: ...
def cubemap_forward(texture: Tensor, directions: Tensor, out: Tensor) -> None: ...
def cubemap_backward(
    texture: Tensor,
    directions: Tensor,
    grad_out: Tensor,
    grad_texture: Tensor | None,
    grad_directions: Tensor | None,
) -> None: ...
def mips_forward(textures: Sequence[Tensor], directions: Tensor, level: Tensor, out: Tensor) -> None: ...
def mips_backward(
    textures: Sequence[Tensor],
    directions: Tensor,
    level: Tensor,
    grad_out: Tensor,
    grad_light: Tensor | None,
    grad_textures: Tensor | None,
    grad_directions: Tensor,
    grad_level: Tensor,
) -> None: ...
def harmonics_forward(
    degree: int, means: Tensor, center: Tensor, dc: Tensor, rest: Tensor, out: Tensor
) -> None: ...
def harmonics_backward(
    degree: int,
    means: Tensor,
    center: Tensor,
    dc: Tensor,
    rest: Tensor,
    grad_out: Tensor,
    grad_means: Tensor | None,
    grad_dc: Tensor,
    grad_rest: Tensor | None,
) -> None: ...
def axes_forward(
    means: Tensor,
    quaternions: Tensor,
    log_scales: Tensor,
    center: Tensor,
    outward: Tensor | None,
    grazing: float,
    out: Tensor,
) -> None: ...
def axes_backward(
    means: Tensor,
    quaternions: Tensor,
    log_scales: Tensor,
    center: Tensor,
    outward: Tensor | None,
    grazing: float,
    grad_out: Tensor,
    grad_quaternions: Tensor,
) -> None: ...
def mirrored_forward(means: Tensor, center: Tensor, normals: Tensor, out: Tensor) -> None: ...
def metal_layers(
    features: Tensor,
    rays: Tensor,
    pixels: Tensor,
    first: int,
    least_share: float,
    light: Tensor,
    share: Tensor,
    reflected: Tensor,
    slope: Tensor,
    final: Tensor,
    specular: Tensor,
) -> None: ...
def metal_backward(
    features: Tensor,
    rays: Tensor,
    pixels: Tensor,
    first: int,
    least_share: float,
    light: Tensor,
    grad_final: Tensor | None,
    grad_specular: Tensor | None,
    grad_held: Tensor | None,
    grad_reflected: Tensor | None,
    grad_slope: Tensor | None,
    grad_light: Tensor,
    grad_normal: Tensor,
    grad_metal: Tensor,
) -> None: ...
def turn(directions: Tensor, rotation: Sequence[float], out: Tensor) -> None: ...
def reflect_forward(
    features: Tensor,
    rays: Tensor,
    textures: Sequence[Tensor],
    fresnel: bool,
    local: bool,
    refractive_index: float,
    index: int,
    roughness: int,
    blur: float,
    alpha: Tensor | None,
    directions: Tensor | None,
    level: Tensor | None,
    seen: Tensor | None,
    final: Tensor,
    specular: Tensor,
    diffuse: Tensor,
    reflection: Tensor,
) -> None: ...
def reflect_backward_layers(
    features: Tensor,
    rays: Tensor,
    seen: Tensor,
    fresnel: bool,
    local: bool,
    refractive_index: float,
    index: int,
    grad_final: Tensor | None,
    grad_specular: Tensor | None,
    grad_diffuse: Tensor | None,
    grad_reflection: Tensor | None,
    grad_held_specular: Tensor | None,
    grad_held_diffuse: Tensor | None,
    grad_seen: Tensor,
    grad_texels: Tensor | None,
    grad_features: Tensor,
) -> None: ...
def reflect_backward_directions(
    features: Tensor,
    rays: Tensor,
    roughness: int,
    blur: float,
    alpha: Tensor | None,
    grad_directions: Tensor,
    grad_level: Tensor | None,
    grad_features: Tensor,
) -> None: ...
def gbuffer_split(features: Tensor, alpha: Tensor, normal: Tensor, depth: Tensor | None) -> None: ...
def gbuffer_join(
    alpha: Tensor,
    depth: Tensor | None,
    grad_features: Tensor | None,
    grad_normal: Tensor | None,
    grad_depth: Tensor | None,
    to_features: Tensor,
    to_alpha: Tensor | None,
) -> None: ...
def polarization(
    normal: Tensor,
    rays: Tensor,
    rotation: Tensor,
    specular: Tensor,
    diffuse: Tensor,
    metal: Tensor | None,
    measured: Tensor,
    analyzers: Tensor,
    weight: Tensor | None,
    factor: float,
    refractive_index: float,
    index: Tensor | None,
    grad_normal: Tensor,
    grad_specular: Tensor,
    grad_diffuse: Tensor,
    grad_metal: Tensor | None,
) -> float: ...
def direction(
    normal: Tensor,
    directions: Tensor,
    weight: Tensor | None,
    factor: float,
    plane: bool,
    grad_normal: Tensor,
) -> float: ...
def consistency(
    normal: Tensor,
    rays: Tensor,
    rotation: Tensor,
    depth: Tensor,
    alpha: Tensor,
    weight: Tensor | None,
    factor: float,
    grad_normal: Tensor,
    grad_depth: Tensor,
) -> float: ...
