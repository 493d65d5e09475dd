"""Owned: parameters that are offsets from what they belong to, which a state carries and a load compares."""

import json

import torch
from torch import Tensor, nn

KEY = "_extra_state"  # what torch calls a module's state that is no parameter


class OtherLens(ValueError):
    """A state of another lens or element, or one that does not say what it is of; the message names both."""


class Owned(nn.Module):
    """A module whose parameters mean nothing without what they change.

    Its `state_dict` has an entry "_extra_state" more: the text of `identity` in JSON, as bytes (a uint8 tensor), so
    that a state stays a dictionary of tensors. `bytes(state["_extra_state"].tolist()).decode()` shows it.
    `load_state_dict` refuses a state of another identity, or without one, as older versions wrote it, before any of its
    parameters is changed. Raises OtherLens.
    """

    def identity(self) -> dict:
        """What the parameters belong to, as plain values for JSON."""
        raise NotImplementedError

    def difference(self, before: dict) -> str:
        """How an identity differs from this one, "" where it does not."""
        raise NotImplementedError

    def get_extra_state(self) -> Tensor:
        return torch.tensor(list(json.dumps(self.identity()).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Nothing is set: what a module is of stays."""

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, *lists) -> None:
        stored = state_dict.get(prefix + KEY)
        if stored is None:
            if any(prefix + name in state_dict for name, _ in self.named_parameters(recurse=False)):
                raise OtherLens(
                    "the state does not say which lens or element it is of; an older version wrote it. Learn anew, or, "
                    f"if it is of this one, set state[{prefix + KEY!r}] = module.get_extra_state(), of this "
                    f"{type(self).__name__}, first"
                )
        elif words := self.difference(_read(stored)):
            raise OtherLens(f"the state is of {words}")
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, *lists)


def _read(stored: Tensor) -> dict:
    try:
        found = json.loads(bytes(stored.tolist()).decode())
        if isinstance(found, dict):
            return found
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise OtherLens("the state does not say which lens or element it is of: its identity is damaged")
