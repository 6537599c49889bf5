"""A network of tanh layers forward and backward by hand: what torch computes, to the last bit, in less time."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn


class Passes:
    """Forward and backward pass of an `mlp` with tanh, which autograd is not to record.

    Small networks on one core spend much of autograd's time beside the arithmetic.
    """

    def __init__(self, net: nn.Module) -> None:
        self._layers = [(layer.weight, layer.bias) for layer in net.modules() if isinstance(layer, nn.Linear)]
        self._seen: list[Tensor] = []  # what each layer saw in the last forward pass, (B, inputs) each

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs (B, outputs) for inputs (B, inputs)."""
        self._seen = [x]
        for weight, bias in self._layers[:-1]:
            self._seen.append(torch.addmm(bias, self._seen[-1], weight.t()).tanh_())
        weight, bias = self._layers[-1]
        return torch.addmm(bias, self._seen[-1], weight.t())

    def backward(self, slope: Tensor) -> None:
        """Set the gradient of every weight from the loss's (B, outputs) in the outputs of the last forward pass."""
        first, _ = self._layers[0]
        for (weight, bias), seen in zip(reversed(self._layers), reversed(self._seen), strict=True):
            weight.grad, bias.grad = slope.t().mm(seen), slope.sum(0)
            if weight is not first:
                slope = torch.ops.aten.tanh_backward(slope.mm(weight), seen)


def clip_gradients(parameters: Iterable[nn.Parameter], largest: float) -> None:
    """Scale the gradients down where the norm of all of them together is larger than `largest`.

    It does what `nn.utils.clip_grad_norm_` does, which takes half of its time to sort the gradients by device and type.
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(gradient) for gradient in gradients]))
    factor = (largest / (norm + 1e-6)).clamp_(max=1.0)
    for gradient in gradients:
        gradient.mul_(factor)
