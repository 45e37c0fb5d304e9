"""A device with values, for machines that have none but the CPU.

``OtherDevice`` is a mode. Inside it, what is made on ``THERE`` or moved to it is a tensor that says it lies there, and
computes as on the CPU. As on a GPU, it cannot be read as an array, mixes with CPU tensors only where these are single
numbers, and is not filled by a generator of the CPU. The native kernels leave it alone: they take the CPU's tensors.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

from polarguide.geometry.camera import Camera
from polarguide.raster import Backend, Rasterized, ScreenStatistic, Splats
from polarguide.raster.cpu import rasterize_cpu

# The second of its kind, so that what is kept for each device is kept for this one by itself.
THERE = torch.device("meta", 1)
WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "aten.equal")


class _There(torch.Tensor):
    """A tensor on the other device. ``values``: the same on the CPU."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> _There:
        made: _There = torch.Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=THERE,
        )
        made.values = values
        return made

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"there {list(self.values.shape)}"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside the mode")


class OtherDevice(TorchDispatchMode):
    """Inside, ``THERE`` is a device.

    Attributes:
        waits: how often something was done for which a GPU would be waited for: values read, or pixels counted.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits = 0

    def __enter__(self) -> OtherDevice:
        # torch.tensor(..., device=...) then makes its tensor on the CPU and moves it, which a mode can see.
        self._lifted = torch._C._only_lift_cpu_tensors()
        torch._C._set_only_lift_cpu_tensors(True)
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        torch._C._set_only_lift_cpu_tensors(self._lifted)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), str(func)
        given = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        there = any(isinstance(t, _There) for t in given)
        to = kwargs.get("device")
        ends_there = there if to is None else torch.device(to) == THERE
        if to is not None:
            kwargs["device"] = torch.device("cpu")
        if name.startswith("aten.copy_"):
            ends_there = isinstance(args[0], _There)
        elif there and any(t.ndim and not isinstance(t, _There) for t in given):
            raise RuntimeError(f"{name} mixes devices: {[(type(t).__name__, list(t.shape)) for t in given]}")
        if ends_there and kwargs.get("generator") is not None:
            raise RuntimeError(f"{name} on the other device with a generator of the CPU")
        if there:
            counted = "index" in name and any(t.dtype == torch.bool for t in given[1:])
            self.waits += not ends_there or counted or any(word in name for word in WAITS)
        result = func(*tree_map(_values, args), **tree_map(_values, kwargs))
        if not ends_there:
            return result
        wrapped = tree_map(lambda t: _There(t) if isinstance(t, Tensor) else t, result)
        return return_and_correct_aliasing(func, args, kwargs, wrapped) if there else wrapped


def _values(argument: Any) -> Any:
    return argument.values if isinstance(argument, _There) else argument


class _Bring(torch.autograd.Function):
    """From there to the CPU, and gradients back; uncounted."""

    @staticmethod
    def forward(ctx: Any, there: Tensor) -> Tensor:
        return _values(there).clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _There(grad)


class _Return(torch.autograd.Function):
    """From the CPU to there, and gradients back; uncounted."""

    @staticmethod
    def forward(ctx: Any, here: Tensor) -> Tensor:
        return _There(here.clone())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _values(grad)


def rasterize(
    splats: Splats,
    camera: Camera,
    *,
    statistic: ScreenStatistic | None = None,
    still: tuple[int, ...] = (),
) -> Rasterized:
    """The CPU's rasterizer for tensors there; pictures, gradients and the statistic are there, too."""
    assert all(isinstance(t, _There) for t in splats)
    here = Splats(*(_Bring.apply(t) for t in splats))
    own = None if statistic is None else ScreenStatistic(statistic.channels)
    if own is not None and here[0].requires_grad:

        def fill(_: Tensor) -> None:
            assert statistic is not None
            assert own.gradient is not None
            statistic.gradient = _There(own.gradient)

        here[0].register_hook(fill)
    found = rasterize_cpu(here, camera, statistic=own, still=still)
    return Rasterized(*(None if t is None else _Return.apply(t) for t in found))


BACKEND = Backend(THERE, rasterize)


def unfused_adam(
    tensors: list[Tensor],
    gradients: list[Tensor],
    exp_avgs: list[Tensor],
    exp_avg_sqs: list[Tensor],
    _: list[Tensor],
    steps: list[Tensor],
    *,
    beta1: float,
    beta2: float,
    lr: float,
    eps: float,
    **others: Any,
) -> None:
    """In place of torch's fused kernel of Adam, which knows its devices by name."""
    for tensor, gradient, first, second, step in zip(
        tensors, gradients, exp_avgs, exp_avg_sqs, steps, strict=True
    ):
        step.add_(1)
        first.mul_(beta1).add_(gradient, alpha=1 - beta1)
        second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        root = (second / (1 - beta2**step)).sqrt() + eps
        tensor.sub_(lr * first / (1 - beta1**step) / root)
