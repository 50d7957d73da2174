"""An accelerator that is none: tensors of a device ``pretend``, whose numbers are computed on the CPU.

Its device is torch's ``PrivateUse1``, so that allocation, autograd, autocast, generators and optimisers take the paths
that they take on a GPU. An operation on tensors of both sides fails as it does there, and what would make the processor
wait for the accelerator is counted. A process registers it once, before it computes its first gradient.
"""

from functools import partial

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map_only
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

NAME = "pretend"
aten = torch.ops.aten

WAITS = {aten._local_scalar_dense, aten.nonzero, aten.masked_select, aten.equal, aten.is_nonzero, aten.unique_dim}
"""Operations whose result the processor needs before it can go on."""
AUTOCAST = {
    "lower": ("addmm", "baddbmm", "bmm", "linear", "matmul", "mm"),
    "full": ("exp", "log", "log1p", "reciprocal", "rsqrt", "softplus", "cumsum", "log_softmax.int", "softmax.int",
             "pow.Tensor_Scalar", "pow.Tensor_Tensor", "prod", "sum", "sum.dim_IntList"),
}  # fmt: skip
"""Operations that CUDA's autocast runs in the lower precision, and those that it runs in float32."""


class Module(_DummyBackendModule):
    """What ``torch.pretend`` offers."""

    def synchronize(self):
        pass

    def get_amp_supported_dtype(self):
        return [torch.bfloat16]


class PretendTensor(torch.Tensor):
    """A tensor on the device, with its numbers in ``held``.

    ``on_wait`` is called with the operation whenever the processor would have to wait for the device.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl
    on_wait = staticmethod(lambda operation: None)

    @staticmethod
    def __new__(cls, held):
        # To autograd's engine, which has no queue for devices of Python, the tensor is one of shapes alone.
        shape = torch.empty(held.untyped_storage().nbytes() // held.itemsize, dtype=held.dtype, device="meta")
        shape = shape.as_strided(held.shape, held.stride(), held.storage_offset())
        tensor = torch.Tensor._make_subclass(cls, shape, device_for_backend_keys=torch.device(NAME))
        tensor.held = held
        return tensor

    @property
    def device(self):
        return torch.device(NAME, 0)

    def __setitem__(self, index, value):
        if not isinstance(value, torch.Tensor):
            value = torch.full((), value, dtype=self.dtype, device=NAME)
        super().__setitem__(index, value)

    def tolist(self):
        return self.cpu().tolist()

    def to(self, *args, copy=False, **kwargs):
        if copy:
            return self.clone().to(*args, **kwargs)
        device, dtype, *_ = torch._C._nn._parse_to(*args, **kwargs)
        if device is not None and device.type == "meta":
            return self.held.to(*args, **kwargs)
        if device is not None and device.type == NAME:
            return self if dtype in (None, self.dtype) else super().to(dtype)
        return super().to(*args, **kwargs)

    def __repr__(self):
        return f"PretendTensor({self.held})"

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return dispatch(operation, args, dict(kwargs or {}))


class Accelerator(TorchDispatchMode):
    """Puts on the device what torch makes for it from nothing, such as the number that a tensor is compared with."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if PretendTensor in types or torch.device(kwargs.get("device") or "cpu").type == "meta":
            return dispatch(operation, args, kwargs)
        return operation(*args, **kwargs)


def dispatch(operation, args, kwargs):
    """Do an operation of the device on the CPU, and count it if the processor would have to wait for it."""
    tensors = [value for value in tree_iter((args, kwargs)) if isinstance(value, torch.Tensor)]
    copies = operation.overloadpacket in (aten.copy_, aten._to_copy)
    if not copies:
        require_one_device(operation, args, tensors)
    arrives = torch.device(kwargs.get("device") or NAME).type != "cpu"
    if operation is aten.copy_.default:
        arrives = isinstance(args[0], PretendTensor)
    if operation.overloadpacket in WAITS or (copies and not arrives) or picks_by_mask(operation, args):
        PretendTensor.on_wait(operation)
    if kwargs.get("device") is not None:
        kwargs["device"] = torch.device("cpu")
    changed = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, PretendTensor)}
    plain = partial(tree_map_only, PretendTensor, lambda tensor: tensor.held)
    result = operation(*plain(args), **plain(kwargs))
    if operation is aten.copy_.default:
        return args[0]
    if not arrives:
        return result
    return tree_map_only(
        torch.Tensor, lambda held: changed.get(id(held)) if id(held) in changed else PretendTensor(held), result
    )


def require_one_device(operation, args, tensors):
    """Refuse tensors of the CPU beside those of the device, but for single numbers outside lists."""
    single = {id(value) for value in args if isinstance(value, torch.Tensor) and value.ndim == 0}
    for tensor in tensors:
        if not isinstance(tensor, PretendTensor) and id(tensor) not in single:
            raise RuntimeError(f"{operation} mixes a tensor {tuple(tensor.shape)} of the CPU with tensors of {NAME}")


def picks_by_mask(operation, args):
    """Tell whether the shape of a result, or what is written, depends on a mask."""
    if operation.overloadpacket not in (aten.index, aten.index_put_, aten._index_put_impl_):
        return False
    return any(index is not None and index.dtype == torch.bool for index in args[1])


def register():
    """Make the device known to torch, for the rest of the process.

    Returns:
        What must be kept, for the operations last as long.
    """
    _setup_privateuseone_for_python_backend(NAME, backend_module=Module())
    library, everything = torch.library.Library("aten", "IMPL"), torch.library.Library("_", "IMPL")
    library.impl("empty.memory_format", factory(torch.empty), "PrivateUse1")
    library.impl("empty_strided", factory(torch.empty_strided), "PrivateUse1")
    library.impl("copy_", copy, "PrivateUse1")
    library.impl("arange.start_step", factory(torch.arange), "PrivateUse1")
    library.impl("arange.start", factory(torch.arange), "PrivateUse1")
    everything.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
    for kind, names in AUTOCAST.items():
        dtype = torch.bfloat16 if kind == "lower" else torch.float32
        for name in names:
            library.impl(name, cast(name, dtype), "AutocastPrivateUse1")
    return library, everything


def copy(target, source, non_blocking=False):
    """Copy to the device, as ``torch.tensor`` does below all dispatch of Python."""
    return dispatch(aten.copy_.default, (target, source), {})


def factory(make):
    """Return what makes tensors on the device as ``make`` does on the CPU."""

    def made(*args, dtype=None, **kwargs):
        return PretendTensor(make(*args, dtype=dtype))

    return made


def cast(name, dtype):
    """Return an operation that autocast runs in another precision."""
    packet, _, overload = name.partition(".")
    operation = getattr(getattr(aten, packet), overload or "default")

    def run(*args, **kwargs):
        with torch._C._ExcludeDispatchKeyGuard(torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastPrivateUse1)):
            change = partial(tree_map_only, torch.Tensor, lambda x: x.to(dtype) if x.is_floating_point() else x)
            return operation(*change(args), **change(kwargs))

    return run
