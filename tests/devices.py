"""A simulated accelerator: tensors that say they lie on ``cuda:0``, while their numbers are the CPU's.

A tensor's storage carries the mark. Everything that asks for a device gets the simulated one, every kernel
is refused that mixes the two as a GPU would refuse it, and every number is as on the CPU: a training run on
the simulated device ends with the same figures, to the bit, as one without. Stricter than a GPU in one point:
an index in the CPU's memory is refused, too, since each use of it waits for a copy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import MagicMock, patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

DEVICE = torch.device("cuda:0")
CPU = torch.device("cpu")
_COPIES = (torch.ops.aten.copy_, torch.ops.aten._to_copy)
_MOVES = (Tensor.to, Tensor.cpu, Tensor.cuda)
_ANSWERS = {Tensor.device.__get__: DEVICE, Tensor.is_cuda.__get__: True, Tensor.is_cpu.__get__: False}
_TO_NUMPY = (Tensor.numpy, Tensor.__array__)


class MixedDevices(RuntimeError):
    """A kernel got tensors of two devices."""


def is_on_device(tensor: Tensor) -> bool:
    """Return whether a tensor lies on the simulated device."""
    with torch._C.DisableTorchFunction():
        return tensor.layout is torch.strided and getattr(tensor.untyped_storage(), "is_simulated", False)


def _mark(tensor: Tensor, on_device: bool) -> Tensor:
    with torch._C.DisableTorchFunction():
        tensor.untyped_storage().is_simulated = on_device
    return tensor


@contextmanager
def simulated_device() -> Iterator[None]:
    """Let ``cuda:0`` be there inside the block."""
    state = torch.zeros(16, dtype=torch.uint8)  # of the device's generator; draws are the CPU's

    known: dict[str, Any] = {
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "synchronize": lambda device=None: None,
        # a build with CUDA asks the driver, which may be missing
        "is_current_stream_capturing": lambda: False,
        "Event": MagicMock(),
        "cudart": MagicMock(),
        "manual_seed_all": lambda seed: state.fill_(seed % 251),
        "get_rng_state": lambda device=None: state.clone(),
        "get_rng_state_all": lambda: [state.clone()],
        "set_rng_state": lambda given, device=None: state.copy_(given),
    }
    # memories do not ask cuDNN, whose kernels are not the CPU's
    no_cudnn = patch.object(torch.backends.cudnn, "is_acceptable", lambda tensor: False)
    with patch.multiple(torch.cuda, **known), no_cudnn, _Kernels(), _Calls():
        yield


class _Kernels(TorchDispatchMode):
    """Refuse kernels over two devices; results lie where what they were made from does."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.overloadpacket in _COPIES:
            return self._copy(func, args, kwargs)

        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        on_device = any(map(is_on_device, given))
        if on_device:
            _check(func, given, args)

        out = func(*args, **kwargs)
        if on_device:
            for made in tree_leaves(out):
                if isinstance(made, Tensor):
                    _mark(made, True)
        return out

    def _copy(self, func: Any, args: Any, kwargs: Any) -> Any:
        out = func(*args, **kwargs)
        # `copy_` writes across devices; `_to_copy` to a device is `_Calls`' matter, here it changes the type
        if func.overloadpacket is torch.ops.aten._to_copy:
            _mark(out, is_on_device(args[0]))
        return out


def _check(func: Any, given: list[Tensor], args: Any) -> None:
    # a number on the CPU may go with anything, but nothing of a device goes into it
    apart = [x for x in given if not is_on_device(x) and x.dim() > 0]
    written = [a for a, s in zip(args, func._schema.arguments) if s.alias_info and s.alias_info.is_write]
    apart += [x for x in tree_leaves(written) if isinstance(x, Tensor) and not is_on_device(x)]
    if apart:
        shapes = [f"{tuple(x.shape)} on {DEVICE if is_on_device(x) else CPU}" for x in given]
        raise MixedDevices(f"{func}: " + ", ".join(shapes))


class _Calls(TorchFunctionMode):
    """Answer what asks for a device or names one."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in _ANSWERS and is_on_device(args[0]):
            return _ANSWERS[func]
        if func in _TO_NUMPY and is_on_device(args[0]):
            raise TypeError(f"can't convert {DEVICE} device type tensor to numpy")
        if func in _MOVES or (func is torch.as_tensor and isinstance(args[0], Tensor)):
            return _move(func, args, kwargs)
        if func in (Tensor.__deepcopy__, Tensor.new_tensor):
            return _mark(func(*args, **kwargs), is_on_device(args[0]))

        if kwargs.get("device") is None or not _is_simulation(torch.device(kwargs["device"])):
            return func(*args, **kwargs)
        wanted = torch.device(kwargs["device"]) != CPU
        return _mark(func(*args, **kwargs | {"device": CPU}), wanted)


def _is_simulation(device: torch.device) -> bool:
    return device in (CPU, DEVICE, torch.device(DEVICE.type))


def _move(func: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor:
    """Do what `Tensor.to` and its relatives do."""
    tensor, *rest = args
    wanted = {Tensor.cpu: CPU, Tensor.cuda: DEVICE}.get(func)
    for value in [*rest, *kwargs.values()]:
        if isinstance(value, (str, torch.device)):
            wanted = torch.device(value)
        elif isinstance(value, Tensor):
            wanted = DEVICE if is_on_device(value) else value.device
    if wanted is not None and not _is_simulation(wanted):
        return func(*args, **kwargs)

    here = is_on_device(tensor)
    there = here if wanted is None else wanted != CPU
    rest = [CPU if isinstance(value, (str, torch.device)) else value for value in rest]
    kwargs = {key: CPU if key == "device" and value is not None else value for key, value in kwargs.items()}
    out = tensor if func in (Tensor.cpu, Tensor.cuda) else func(tensor, *rest, **kwargs)
    if here == there:
        return out
    # another device is another place: nothing that is written here is seen there
    shared = out.untyped_storage().data_ptr() == tensor.untyped_storage().data_ptr()
    return _mark(out.clone() if shared else out, there)
