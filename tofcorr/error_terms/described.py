"""Modules whose state says what they compute, so that the state of another module is refused."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from tofcorr.errors import StateError


class DescribedModule(nn.Module):
    """A module that stores a description of itself in its `state_dict`.

    All that the output depends on is a parameter, a buffer, or part of the description. Parameters
    and buffers are loaded; the description must be equal.
    """

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded, as plain values."""
        raise NotImplementedError

    def get_extra_state(self) -> Tensor:
        """Return the description as JSON in a tensor of bytes.

        A tensor, so that every value of a `state_dict` is one.
        """
        return encode(self.description())

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse the state of a module that computes something else.

        Raises:
            StateError: The description differs; the message names the first difference.
        """
        self._require_same(state)

    def _description_in(self, state: Tensor) -> dict[str, Any]:
        """Return the description that `get_extra_state` of a module of this class stored."""
        return decode(state)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:  # noqa: ANN401 - torch's own named tuple
        """Load a state; refuse that of a module that computes something else untouched.

        Raises:
            StateError: The description differs; the message names the first difference.
        """
        if "_extra_state" in state_dict:
            self._require_same(state_dict["_extra_state"])
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def _require_same(self, state: Tensor) -> None:
        require_equal(self._description_in(state), self.description(), type(self).__name__)

    def register_number(self, name: str, value: float) -> None:
        """Keep a number in the state: a buffer of shape (), float64."""
        self.register_buffer(name, torch.tensor(float(value), dtype=torch.float64))


def encode(values: dict[str, Any]) -> Tensor:
    """Return plain values as JSON in a tensor of bytes, uint8."""
    return torch.tensor(list(json.dumps(values).encode()), dtype=torch.uint8)


def decode(state: Tensor) -> dict[str, Any]:
    """Return the plain values that `encode` stored."""
    return json.loads(bytes(state.tolist()).decode())


def require_equal(stored: dict[str, Any], own: dict[str, Any], name: str) -> None:
    """Refuse a stored description that differs from a module's own.

    Raises:
        StateError: The message names the first difference.
    """
    for key in dict.fromkeys([*own, *stored]):
        expected, found = own.get(key), stored.get(key)
        if found != json.loads(json.dumps(expected)):
            raise StateError(
                f"{name}: the state is of another model: its '{key}' is {found}, "
                f"this module's is {expected}. Build the module as the saved one was built."
            )
