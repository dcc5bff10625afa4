"""A GPU for machines without one: tensors compute on the CPU and say that they are on `cuda:0`.

While `PretendedGpu` is entered, what mixes devices fails as it would there, and each place of the package that makes
the host wait for the device is written down. (Fake tensors have no values, without which no loop over rays ends.)
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

from nerfro.core.paths import PACKAGE_DIR, PLUGINS_DIR
from nerfro.kernels.operators import REFERENCES

GPU = torch.device("cuda", 0)

# These bring values or counts to the host.
_WAITING = {"item", "tolist", "__bool__", "__float__", "__int__", "__index__", "nonzero", "argwhere", "unique"}
_WAITING |= {"masked_select", "is_nonzero", "equal", "allclose", "__contains__", "bincount"}
# These take tensors of both devices.
_MIXING = {"to", "copy_", "__getitem__", "__setitem__", "__get__", "__set__"}


class OnGpu(torch.Tensor):
    """A tensor that says it is on the GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: GPU)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]


class Launches(TorchDispatchMode):
    """Count the operators that a GPU would launch; views need no launch."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        self.count += not (func.is_view or func.overloadpacket.__name__ in ("detach", "empty", "_unsafe_view"))
        return func(*args, **(kwargs or {}))


class PretendedGpu(TorchFunctionMode):
    """`with PretendedGpu() as gpu:` gives the machine a GPU; `gpu.waits` are places where the host waited for it.

    `gpu.launches.count` is the number of operators on the GPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: set[str] = set()
        self.launches = Launches()

    def __torch_function__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        tensors = list(_tensors((args, *kwargs.values())))
        here = any(isinstance(tensor, OnGpu) for tensor in tensors)
        elsewhere = any(not isinstance(tensor, OnGpu) and tensor.ndim > 0 for tensor in tensors)
        if name == "_has_compatible_shallow_copy_type":
            return False  # modules that move get new parameters
        if name in ("numpy", "__array__") and here:
            raise TypeError("a tensor on the GPU has no NumPy array")
        if here and elsewhere and name not in _MIXING:
            raise RuntimeError(f"{name}: tensors on cuda:0 and on the CPU")
        if here and (name in _WAITING or elsewhere or _masks(name, args)):
            self._waited(name)
        if here and getattr(func, "namespace", None) == "nerfro":
            with self:  # the tensors dispatch as those of the CPU
                # As PyTorch passes them to an operator.
                values = [list(value) if isinstance(value, tuple) else value for value in args]
                return REFERENCES[name.partition(".")[0]](*values, **kwargs)
        if name in ("to", "cpu"):
            return self._to(*args, *(["cpu"] if name == "cpu" else []), **kwargs)
        if "device" in kwargs and kwargs["device"] is not None:
            here = torch.device(kwargs["device"]).type == "cuda"
            if here and name in ("tensor", "as_tensor", "new_tensor"):
                self._waited(name)
            kwargs["device"] = "cpu"
        if not here:
            return func(*args, **kwargs)
        with self.launches:
            return _on_gpu(func(*args, **kwargs))

    def _to(self, tensor: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        """`Tensor.to`, between the devices a copy."""
        targets = [a.device if isinstance(a, torch.Tensor) else a for a in (*args, *kwargs.values())]
        wanted = [torch.device(t).type for t in targets if isinstance(t, (torch.device, str))]
        from_gpu = isinstance(tensor, OnGpu)
        to_gpu = wanted[-1] == "cuda" if wanted else from_gpu
        if to_gpu != from_gpu and not kwargs.get("non_blocking"):
            self._waited("to")
        local = tree_map(lambda a: "cpu" if isinstance(a, (torch.device, str)) else a, (args, kwargs))
        moved = tensor.as_subclass(torch.Tensor).to(*local[0], **local[1])
        if to_gpu != from_gpu:
            moved = moved.clone()
            self.launches.count += 1
        return moved.as_subclass(OnGpu) if to_gpu else moved

    def _waited(self, name: str) -> None:
        for frame in _frames():
            path = Path(frame.f_code.co_filename)
            folder = next((folder for folder in (PLUGINS_DIR, PACKAGE_DIR) if folder in path.parents), None)
            if folder is not None:
                self.waits.add(f"{path.relative_to(folder)}: {frame.f_code.co_name} ({name})")
                return


def _tensors(values: Any) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _on_gpu(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value if isinstance(value, OnGpu) else value.as_subclass(OnGpu)
    several = isinstance(value, (tuple, list)) and not isinstance(value, torch.Size)
    return type(value)([_on_gpu(part) for part in value]) if several else value


def _masks(name: str, args: tuple) -> bool:
    """Whether places are chosen by a mask, whose number must be known; not so where one value fills all of them."""
    if name not in ("__getitem__", "__setitem__"):
        return False
    filled = name == "__setitem__" and not (isinstance(args[2], torch.Tensor) and args[2].ndim > 0)
    return not filled and any(i.dtype == torch.bool for i in _tensors(args[1:2]))


def _frames() -> Iterator[Any]:
    frame: Any = sys._getframe(1)
    while frame is not None:
        yield frame
        frame = frame.f_back
