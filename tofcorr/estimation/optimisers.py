"""torch's optimisers without torch's compiler, which takes as long to import as torch itself."""

import inspect
from typing import TypeVar, cast

import torch
from torch.optim import Optimizer

Kind = TypeVar("Kind", bound=Optimizer)


def uncompiled(kind: type[Kind]) -> type[Kind]:
    """Return an optimiser that takes the same steps and does not import `torch._dynamo`.

    `torch.optim` wraps some methods so that compiled code leaves them out; the wrapper imports the
    compiler at the first call. Outside compiled code the wrapped function does the same.

    Args:
        kind: A class of `torch.optim`, to be used without `differentiable`.
    """
    methods = {
        name: inspect.unwrap(getattr(kind, name)) for name in ("add_param_group", "zero_grad")
    }
    methods["step"] = torch.no_grad()(inspect.unwrap(kind.step))
    return cast(type[Kind], type(kind.__name__, (kind,), methods))
