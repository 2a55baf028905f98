"""A GPU for machines without one: CPU memory that says it is `cuda:0`, with real numbers and CUDA's rules.

with fake_gpu() as gpu:      # torch.cuda.is_available(), .to("cuda"), autocast, gsplat (a stand-in) work
    train(…)
    gpu.syncs                # what the host has waited for, by kind

What breaks a rule of CUDA raises the error that a GPU would raise: tensors of two devices in one operation, a
NumPy array of a tensor on the GPU, a CPU generator that draws on the GPU. (torch's own FakeTensorMode has no
values for `.item()`, and its backward pass wants a real context.)
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
import torch._dynamo  # looks at torch.cuda when it is imported, so before that is patched
import transformers
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from lang3dxl_ns.rendering.torch_rasterizer import Compositing

aten = torch.ops.aten
CUDA = torch.device("cuda", 0)
MEMORY = 24 * 10**9

COPIES = {aten.copy_, aten._to_copy, aten.equal, aten.is_same_size}
"""Operations that may be given tensors of two devices."""
INDEXING = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_, aten._unsafe_index}
"""Operations whose indices may lie on the CPU."""
NO_SCALARS = {
    *(
        aten.mm,
        aten.bmm,
        aten.addmm,
        aten.cat,
        aten.stack,
        aten.convolution,
        aten.searchsorted,
        aten.bincount,
    ),
    *(aten.gather, aten.scatter, aten.index_select, aten.index_add, aten.index_add_, aten.index_copy),
    *(aten.index_copy_, aten._embedding_bag, aten._embedding_bag_forward_only),
}
"""Operations in which even a number on the CPU (a tensor without dimensions) may not meet the GPU."""
WAITS = {
    aten._local_scalar_dense,
    aten.nonzero,
    aten._unique2,
    aten.unique_dim,
    aten.equal,
    aten.masked_select,
}
"""Operations whose result the host needs: it waits for everything that was launched before."""

_syncs: Counter[str] = Counter()


class GpuTensor(torch.Tensor):
    """Python and the dispatcher (autocast) see a CUDA tensor, autograd's C++ engine sees a CPU tensor."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    @staticmethod
    def of(tensor: torch.Tensor) -> GpuTensor:
        return torch.Tensor._make_subclass(GpuTensor, tensor.detach(), False, device_for_backend_keys=CUDA)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})

    @property
    def grad(self):
        grad = _GRAD.__get__(self)
        if grad is not None and not isinstance(grad, GpuTensor):  # C++ made it "like" the parameter
            grad = GpuTensor.of(grad)
            _GRAD.__set__(self, grad)
        return grad

    @grad.setter
    def grad(self, value):
        _GRAD.__set__(self, value)

    def numpy(self, **_):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")

    def __array__(self, *_, **__):
        return self.numpy()

    def tolist(self):
        _syncs["tolist"] += 1
        return cpu_copy(self).tolist()

    def quantile(self, *args, **kwargs):
        return GpuTensor.of(cpu_copy(self).quantile(*args, **kwargs))

    def get_device(self):
        return 0

    def __repr__(self, *_, **__):
        return f"GpuTensor({cpu_copy(self)})"

    def __format__(self, spec):
        return format(self.item(), spec) if self.dim() == 0 else repr(self)

    def __reduce_ex__(self, protocol):
        return cpu_copy(self).__reduce_ex__(protocol)

    def __deepcopy__(self, memo):
        copy = GpuTensor.of(cpu_copy(self).clone()).requires_grad_(self.requires_grad)
        return torch.nn.Parameter(copy, self.requires_grad) if getattr(self, "_is_param", False) else copy


_GRAD = torch.Tensor.grad
_DEVICE = torch.Tensor.device.__get__
_TO = torch.Tensor.to
_TENSOR, _AS_TENSOR = torch.tensor, torch.as_tensor


def cpu_copy(tensor: torch.Tensor) -> torch.Tensor:
    """The memory of a tensor on the GPU as a CPU tensor (the same memory)."""
    with torch._C._DisableTorchDispatch():
        plain = torch.empty(0, dtype=tensor.dtype)
        return plain.set_(tensor.untyped_storage(), tensor.storage_offset(), tensor.size(), tensor.stride())


# ── operations ──────────────────────────────────────────────────────────────────────────────────────────


def _run(func: Any, args: tuple, kwargs: dict) -> Any:
    """Check an operation, compute it on the CPU, and put the result where CUDA would put it."""
    tensors: list[torch.Tensor] = []
    _find_tensors((args, kwargs), tensors)
    on_gpu = _result_on_gpu(func, kwargs, tensors)
    _check(func, args, kwargs, tensors, on_gpu)
    _count(func, args, kwargs, tensors, on_gpu)
    originals = {}

    def lowered(leaf: Any) -> Any:
        if isinstance(leaf, GpuTensor):
            plain = cpu_copy(leaf)
            originals[id(plain)] = leaf, plain
            return plain
        return torch.device("cpu") if isinstance(leaf, torch.device) and leaf.type == "cuda" else leaf

    def lifted(leaf: Any) -> Any:
        if not isinstance(leaf, torch.Tensor):
            return leaf
        if id(leaf) in originals:
            return originals[id(leaf)][0]
        return GpuTensor.of(leaf) if on_gpu else leaf

    args, kwargs = _changed(lowered, args), _changed(lowered, kwargs)
    if kwargs.get("pin_memory"):
        kwargs["pin_memory"] = False
    result = func(*args, **kwargs)
    for original, plain in originals.values():  # squeeze_ and the like, which change a tensor's own shape
        if original.shape != plain.shape:
            with torch._C._DisableTorchDispatch():
                original.set_(plain.untyped_storage(), plain.storage_offset(), plain.size(), plain.stride())
    return _changed(lifted, result)


def _find_tensors(value: Any, found: list[torch.Tensor]) -> None:
    """Append the tensors in lists, tuples and dictionaries, in their order."""
    if isinstance(value, torch.Tensor):
        found.append(value)
    elif isinstance(value, list | tuple):
        for each in value:
            _find_tensors(each, found)
    elif isinstance(value, dict):
        for each in value.values():
            _find_tensors(each, found)


def _changed(change: Callable[[Any], Any], value: Any) -> Any:
    """The value with all that is in its lists, tuples and dictionaries changed. An operation's arguments have
    no other containers, and torch's trees take half of the time."""
    if isinstance(value, list | tuple):
        kind = list if isinstance(value, list) else tuple
        return kind([_changed(change, each) for each in value])
    if isinstance(value, dict):
        return {name: _changed(change, each) for name, each in value.items()}
    return change(value)


def _result_on_gpu(func: Any, kwargs: dict, tensors: list) -> bool:
    has_gpu = any(isinstance(tensor, GpuTensor) for tensor in tensors)
    device = kwargs.get("device")
    # A cast inside C++, which takes its tensor for one on the CPU; moves in Python are in `_moved`.
    if device is None or (func.overloadpacket in (aten._to_copy, aten.index_put) and has_gpu):
        return has_gpu
    return torch.device(device).type == "cuda"


def _check(func: Any, args: tuple, kwargs: dict, tensors: list, on_gpu: bool) -> None:
    """Raises RuntimeError, in CUDA's words, if a GPU would refuse this operation."""
    generator, packet = kwargs.get("generator"), func.overloadpacket
    if generator is not None and on_gpu and generator.device.type == "cpu":
        raise RuntimeError(f"{func}: Expected a 'cuda' device type for generator but found 'cpu'")
    others = [tensor for tensor in tensors if not isinstance(tensor, GpuTensor)]
    if len(others) in (0, len(tensors)) or packet in COPIES:
        return
    if packet in INDEXING:
        if not isinstance(args[0], GpuTensor):
            # C++'s backward of indexing says `index_put` of zeros that it made "like" a tensor on the GPU.
            wrong = [] if packet is aten.index_put else [args[0]]
        else:
            values = [value for value in args[2:3] if isinstance(value, torch.Tensor)]
            wrong = [v for v in values if not isinstance(v, GpuTensor) and v.dim()]
    elif packet in NO_SCALARS:
        wrong = others
    else:
        wrong = [tensor for tensor in others if tensor.dim()]
        if func._schema.is_mutable and args and any(args[0] is tensor for tensor in others):
            wrong = [args[0]]
    if wrong:
        shapes = [tuple(tensor.shape) for tensor in tensors]
        raise RuntimeError(
            f"{func}: Expected all tensors to be on the same device, but found at least two devices, cuda:0 "
            f"and cpu! (shapes {shapes}, on the CPU {[tuple(tensor.shape) for tensor in wrong]})"
        )


def _count(func: Any, args: tuple, kwargs: dict, tensors: list, on_gpu: bool) -> None:
    """Count the operation if the host would wait for the GPU."""
    gpu, packet = [isinstance(tensor, GpuTensor) for tensor in tensors], func.overloadpacket
    if not any(gpu):
        return
    if packet in WAITS or (packet is aten.repeat_interleave and kwargs.get("output_size") is None):
        _syncs[str(packet)] += 1
    # A mask is turned into indices, whose number the host needs; indices of the CPU are copied.
    indices = [i for i in args[1] if isinstance(i, torch.Tensor)] if packet in INDEXING else []
    if any(index.dtype == torch.bool or not isinstance(index, GpuTensor) for index in indices):
        _syncs[f"{packet} by a mask or the CPU's indices"] += 1
    # In a backward pass, C++ puts a gradient into memory that it made "like" the parameter.
    in_backward = torch._C._current_graph_task_id() != -1
    if packet is aten.copy_ and not all(gpu) and not in_backward:
        patient = args[2] if len(args) > 2 else kwargs.get("non_blocking", False)
        _syncs["copy_ between devices"] += not patient


# ── moving between devices ──────────────────────────────────────────────────────────────────────────────


class _Up(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return GpuTensor.of(tensor.detach().clone())

    @staticmethod
    def backward(ctx, grad):
        return cpu_copy(grad.detach()).clone()


class _Down(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return cpu_copy(tensor.detach()).clone()

    @staticmethod
    def backward(ctx, grad):
        return GpuTensor.of(grad.detach().clone())


def _moved(self, *args, **kwargs):
    """Tensor.to. A copy between devices is a wait, unless it is non_blocking and goes up."""
    wanted, rest = dict(kwargs), []
    for value in args:
        if isinstance(value, torch.Tensor):
            wanted |= {"device": value.device, "dtype": value.dtype}
        elif isinstance(value, torch.dtype):
            wanted["dtype"] = value
        elif isinstance(value, str | torch.device):
            wanted["device"] = value
        elif isinstance(value, int) and not isinstance(value, bool):
            wanted["device"] = f"cuda:{value}"
        else:
            rest.append(value)
    wanted |= dict(
        zip(("non_blocking", "copy"), (value for value in rest if value is not None), strict=False)
    )
    other = wanted.pop("other", None)
    if other is not None:
        wanted |= {"device": other.device, "dtype": other.dtype}
    here = "cuda" if isinstance(self, GpuTensor) else _DEVICE(self).type
    device = wanted.get("device")
    there = here if device is None else torch.device(device).type
    if {here, there} - {"cpu", "cuda"}:  # "meta", as models are loaded
        return _TO(self, *args, **kwargs)
    out, patient = self, wanted.get("non_blocking", False)
    if here != there:
        if there == "cpu" or not patient:
            _syncs[f"copy to {there}"] += 1
        out = (_Up if there == "cuda" else _Down).apply(self)
    dtype, layout = wanted.get("dtype") or out.dtype, wanted.get("memory_format")
    if dtype != out.dtype or layout is not None:
        return _TO(out, dtype) if layout is None else _TO(out, dtype, memory_format=layout)
    return out.clone() if wanted.get("copy") and out is self else out


def _tensor(data, *, dtype=None, device=None, requires_grad=False, pin_memory=False):
    out = _TENSOR(data, dtype=dtype)
    return (out if device is None else out.to(device)).requires_grad_(requires_grad)


def _as_tensor(data, dtype=None, device=None):
    out = data if isinstance(data, torch.Tensor) else _AS_TENSOR(data)
    return out.to(device=device, dtype=dtype)


def _new_tensor(self, data, *, dtype=None, device=None, requires_grad=False, **_):
    dtype, device = dtype or self.dtype, device or self.device
    return _tensor(data, dtype=dtype, device=device, requires_grad=requires_grad)


_METHODS = {
    "to": _moved,
    "cpu": lambda self, *_, **__: self.to("cpu"),
    "cuda": lambda self, *_, **__: self.to("cuda"),
    "type_as": lambda self, other: self.to(other),
    "pin_memory": lambda self, *_: self,
    "new_tensor": _new_tensor,
}


# ── the GPU ─────────────────────────────────────────────────────────────────────────────────────────────


class _Mode(TorchDispatchMode):
    @classmethod
    def _should_skip_dynamo(cls):
        """Nothing is compiled here, and to tell dynamo so takes time in every operation."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class Gpu:
    """The GPU in use."""

    @property
    def syncs(self) -> dict[str, int]:
        """How often the host had to wait, by reason."""
        return dict(_syncs)

    @contextlib.contextmanager
    def counting(self) -> Iterator[Counter[str]]:
        """The waits inside the block, in the counter once it has ended."""
        before, found = Counter(self.syncs), Counter[str]()
        yield found
        found.update(Counter(self.syncs) - before)


@contextlib.contextmanager
def fake_gpu(memory: int = MEMORY, capability: tuple[int, int] = (8, 9)) -> Iterator[Gpu]:
    """A machine with one GPU, with gsplat built."""
    _syncs.clear()
    with contextlib.ExitStack() as stack:
        for name, value in _cuda(memory, capability).items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        for name, method in _METHODS.items():
            stack.enter_context(mock.patch.object(torch.Tensor, name, method))
        stack.enter_context(mock.patch.object(torch, "tensor", _tensor))
        stack.enter_context(mock.patch.object(torch, "as_tensor", _as_tensor))
        for name in ("_accelerator_graph_capture_health_check", "_cuda_graph_capture_health_check"):
            nothing = lambda *_, **__: None  # noqa: E731
            stack.enter_context(mock.patch.object(torch.optim.Optimizer, name, nothing, create=True))
        load = classmethod(_load_pretrained)
        stack.enter_context(mock.patch.object(transformers.PreTrainedModel, "from_pretrained", load))
        stack.enter_context(mock.patch("gsplat.rasterization", gsplat_stand_in))
        stack.enter_context(mock.patch.object(Compositing, "backward", staticmethod(_stand_in_backward)))
        stack.enter_context(mock.patch("lang3dxl_ns.rendering.gsplat_build.make_ready"))
        stack.enter_context(mock.patch("lang3dxl_ns.rendering.gsplat_build.ready", return_value=True))
        stack.enter_context(_conversions(True))
        stack.enter_context(_Mode())
        yield Gpu()


class RealGpu(Gpu):
    """This machine's own, which does not tell what the host waits for."""

    syncs = property(lambda self: {})  # type: ignore[assignment]


@contextlib.contextmanager
def real_gpu(**_: Any) -> Iterator[Gpu]:
    """This machine's GPU."""
    yield RealGpu()


def _cuda(memory: int, capability: tuple[int, int]) -> dict[str, Any]:
    """Names of torch.cuda, and what they are on this GPU."""
    major, minor = capability
    properties = SimpleNamespace(
        name="Fake GPU", total_memory=memory, major=major, minor=minor, multi_processor_count=128
    )

    def synchronize(*_: Any) -> None:
        _syncs["synchronize"] += 1

    values = {
        **{"is_available": True, "is_initialized": True, "device_count": 1, "current_device": 0},
        **{"is_bf16_supported": capability >= (8, 0), "get_device_name": "Fake GPU"},
        **{"get_device_properties": properties, "get_device_capability": capability},
        **{"mem_get_info": (memory, memory), "get_rng_state_all": [], "get_arch_list": ["sm_86", "sm_120"]},
        **dict.fromkeys(("_lazy_init", "empty_cache", "reset_peak_memory_stats", "set_device"), None),
        **dict.fromkeys(("manual_seed", "manual_seed_all", "set_rng_state_all"), None),
        **dict.fromkeys(("memory_allocated", "max_memory_allocated", "memory_reserved"), 0),
    }
    functions = {name: (lambda *_, _value=value, **__: _value) for name, value in values.items()}
    return {**functions, "synchronize": synchronize}


@contextlib.contextmanager
def _conversions(faked: bool) -> Iterator[None]:
    """How torch makes tensors of Python's data, and how modules move."""
    before = torch._C._only_lift_cpu_tensors(), torch.__future__.get_overwrite_module_params_on_conversion()
    torch._C._set_only_lift_cpu_tensors(faked)
    torch.__future__.set_overwrite_module_params_on_conversion(faked)
    try:
        yield
    finally:
        torch._C._set_only_lift_cpu_tensors(before[0])
        torch.__future__.set_overwrite_module_params_on_conversion(before[1])


_load = transformers.PreTrainedModel.from_pretrained.__func__
_ORIGINAL = {name: getattr(torch.Tensor, name) for name in _METHODS}


def _load_pretrained(cls, *args, **kwargs):
    """As without this GPU: transformers builds on "meta" and on the CPU."""
    with contextlib.ExitStack() as stack:
        for name, method in _ORIGINAL.items():
            stack.enter_context(mock.patch.object(torch.Tensor, name, method))
        stack.enter_context(mock.patch.object(torch, "tensor", _TENSOR))
        stack.enter_context(mock.patch.object(torch, "as_tensor", _AS_TENSOR))
        stack.enter_context(mock.patch.object(torch.cuda, "is_available", return_value=False))
        stack.enter_context(_conversions(False))
        stack.enter_context(_disable_current_modes())
        return _load(cls, *args, **kwargs)


def gsplat_stand_in(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, eps2d, packed,
    render_mode="RGB", rasterize_mode="classic",
):  # fmt: skip
    """gsplat.rasterization (1.4) of one camera, by the torch backend; asserts what gsplat's kernels want."""
    from lang3dxl_ns.rendering import Gaussians, rasterize
    from lang3dxl_ns.rendering.gaussians import ALPHA_MIN
    from lang3dxl_ns.scene.camera import Camera

    given = means, quats, scales, opacities, colors, viewmats, Ks
    assert all(tensor.is_cuda and tensor.dtype == torch.float32 for tensor in given)
    n, channels = colors.shape
    assert n > 0 and channels > 0 and not packed and type(width) is type(height) is int
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, channels), (1, 4, 4), (1, 3, 3)]
    assert [tuple(tensor.shape) for tensor in given] == shapes
    with _uncounted():
        drawn = rasterize(
            Gaussians(means, quats, scales, opacities), Camera(viewmats[0], Ks[0], width, height), colors,
            near=near_plane, eps2d=eps2d, antialiased=rasterize_mode == "antialiased",
            render_depth=render_mode == "RGB+D", backend="torch",
        )  # fmt: skip
    _syncs["gsplat"] += 1  # the number of intersections, for which memory is allocated
    image = drawn.image
    if drawn.depth is not None:  # accumulated
        image = torch.cat([image, drawn.depth * drawn.alpha.clamp_min(ALPHA_MIN / 2)], dim=2)
    return image[None], drawn.alpha[None], drawn.info


_backward = Compositing.backward


def _stand_in_backward(ctx, *gradients):
    with _uncounted():
        return _backward(ctx, *gradients)


@contextlib.contextmanager
def _uncounted() -> Iterator[None]:
    before = Counter(_syncs)
    yield
    _syncs.clear()
    _syncs.update(before)
