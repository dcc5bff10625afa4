"""Base class of modules with one row of parameters per training view."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn


class PerView(nn.Module):
    """Module whose tensors are empty until `begin` or the loading of a checkpoint sets the number of views."""

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, tensor in (*self._parameters.items(), *self._buffers.items()):
            stored = state_dict.get(prefix + name)
            if tensor is not None and stored is not None and len(tensor) == 0:
                tensor.data = stored.new_empty(stored.shape, dtype=tensor.dtype, device=tensor.device)
        super()._load_from_state_dict(state_dict, prefix, *rest)
