"""EfficientNet-lite0 (Tan and Le, ICML 2019), trained on ImageNet: the network by the published names and shapes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights

if TYPE_CHECKING:
    import torch

# (blocks, side of the kernel, stride, expansion, channels out); lite0 has no squeeze and excitation.
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
_STEM = 32
# Of the training in TensorFlow.
_EPSILON = 1e-3
# Up to here the blocks see the image at a sixteenth of its size.
_DENSE_BLOCK = 10
DENSE_WIDTH, DENSE_STRIDE_PX = 112, 16
WHOLE_WIDTH = 1280


def efficientnet() -> torch.nn.ModuleDict:
    """Return the layers of the network without its classifier, by their published names, with random weights."""
    from torch import nn

    def norm(width: int) -> nn.BatchNorm2d:
        return nn.BatchNorm2d(width, eps=_EPSILON)

    blocks, width = [], _STEM
    for count, side, first_stride, expansion, out in _STAGES:
        for number in range(count):
            stride, wide = first_stride if number == 0 else 1, width * expansion
            layers: dict[str, nn.Module] = {}
            if expansion > 1:
                layers |= {"_expand_conv": nn.Conv2d(width, wide, 1, bias=False), "_bn0": norm(wide)}
            layers |= {
                "_depthwise_conv": nn.Conv2d(wide, wide, side, stride=stride, groups=wide, bias=False),
                "_bn1": norm(wide),
                "_project_conv": nn.Conv2d(wide, out, 1, bias=False),
                "_bn2": norm(out),
            }
            blocks.append(nn.ModuleDict(layers))
            width = out
    return nn.ModuleDict(
        {
            "_conv_stem": nn.Conv2d(3, _STEM, 3, stride=2, bias=False),
            "_bn0": norm(_STEM),
            "_blocks": nn.ModuleList(blocks),
            "_conv_head": nn.Conv2d(width, WHOLE_WIDTH, 1, bias=False),
            "_bn1": norm(WHOLE_WIDTH),
        }
    )


def load_efficientnet(folder: Path | None) -> torch.nn.ModuleDict:
    """Return the network with its weights; raises WeightsError without them."""
    path = find_weights(WEIGHTS["efficientnet-lite0"], folder=folder)
    network = efficientnet()
    fill_network(network, read_weights(path), path=path, unused=("_fc",))
    return network


def feature_maps(network: torch.nn.ModuleDict, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return f32[1, 112, h/16, w/16] and f32[1, 1280, h/32, w/32] of an image f32[1, 3, h, w] in 0..1, RGB."""
    from torch.nn.functional import relu6

    # lite0 was trained on (value - 127) / 128.
    x = relu6(network["_bn0"](_same(network["_conv_stem"], (image * 255.0 - 127.0) / 128.0)))
    dense = x
    block: Any
    for number, block in enumerate(network["_blocks"]):  # type: ignore[arg-type]
        before = x
        if "_expand_conv" in block:
            x = relu6(block["_bn0"](block["_expand_conv"](x)))
        x = relu6(block["_bn1"](_same(block["_depthwise_conv"], x)))
        x = block["_bn2"](block["_project_conv"](x))
        if x.shape == before.shape:
            x = x + before
        if number == _DENSE_BLOCK:
            dense = x
    return dense, relu6(network["_bn1"](network["_conv_head"](x)))


def _same(layer: torch.nn.Module, x: torch.Tensor) -> torch.Tensor:
    """Convolve with TensorFlow's "same" padding, which puts an odd pixel at the right and bottom."""
    from torch.nn import Conv2d
    from torch.nn.functional import pad

    assert isinstance(layer, Conv2d)
    total = []
    for size, side, stride in zip(x.shape[-2:], layer.kernel_size, layer.stride, strict=True):
        total.append(max((-(-size // stride) - 1) * stride + side - size, 0))
    (rows, columns) = total
    return layer(pad(x, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2)))  # type: ignore[no-any-return]
