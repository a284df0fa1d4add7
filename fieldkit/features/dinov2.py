"""DINOv2 ViT-S/14 (Oquab et al., TMLR 2024): the network by the published names and shapes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.features.weights import WEIGHTS, fill_network, find_weights, read_weights

if TYPE_CHECKING:
    import torch
    from torch import nn

WIDTH, PATCH_PX = 384, 14
_DEPTH, _HEADS, _EXPANSION = 12, 6, 4
# Patches per side of the images that the stored position embedding belongs to: 518 px.
_GRID = 37
_EPSILON = 1e-6
# ImageNet's mean and deviation of RGB in 0..1.
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def dinov2() -> nn.ModuleDict:
    """Return the layers and embeddings of the network, by their published names, with random weights."""
    import torch
    from torch import nn

    def scale() -> nn.ParameterDict:
        return nn.ParameterDict({"gamma": nn.Parameter(torch.ones(WIDTH))})

    def block() -> nn.ModuleDict:
        return nn.ModuleDict(
            {
                "norm1": nn.LayerNorm(WIDTH, eps=_EPSILON),
                "attn": nn.ModuleDict({"qkv": nn.Linear(WIDTH, 3 * WIDTH), "proj": nn.Linear(WIDTH, WIDTH)}),
                "ls1": scale(),
                "norm2": nn.LayerNorm(WIDTH, eps=_EPSILON),
                "mlp": nn.ModuleDict(
                    {"fc1": nn.Linear(WIDTH, _EXPANSION * WIDTH), "fc2": nn.Linear(_EXPANSION * WIDTH, WIDTH)}
                ),
                "ls2": scale(),
            }
        )

    network = nn.ModuleDict(
        {
            "patch_embed": nn.ModuleDict({"proj": nn.Conv2d(3, WIDTH, PATCH_PX, stride=PATCH_PX)}),
            "blocks": nn.ModuleList([block() for _ in range(_DEPTH)]),
            "norm": nn.LayerNorm(WIDTH, eps=_EPSILON),
        }
    )
    network.register_parameter("cls_token", nn.Parameter(0.02 * torch.randn(1, 1, WIDTH)))
    network.register_parameter("pos_embed", nn.Parameter(0.02 * torch.randn(1, 1 + _GRID * _GRID, WIDTH)))
    return network


def load_dinov2(folder: Path | None) -> nn.ModuleDict:
    """Return the network with its weights; raises WeightsError without them."""
    path = find_weights(WEIGHTS["dinov2-vits14"], folder=folder)
    network = dinov2()
    # The mask token serves the training only.
    fill_network(network, read_weights(path), path=path, unused=("mask_token",))
    return network


def patch_features(network: nn.ModuleDict, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return f32[1, 384, h/14, w/14] and f32[1, 384] of an image f32[1, 3, h, w] in 0..1, RGB, with sides 14 k.

    They are the last layer's normalised tokens: of the patches, and of the image (the class token).
    """
    import torch

    mean, deviation = (torch.tensor(v)[:, None, None] for v in (_MEAN, _DEVIATION))
    patches = network["patch_embed"]["proj"]((image - mean) / deviation)  # type: ignore[index]
    rows, columns = patches.shape[-2:]
    tokens = torch.cat([network.get_parameter("cls_token"), patches.flatten(2).transpose(1, 2)], dim=1)
    x = tokens + _positions(network.get_parameter("pos_embed"), rows, columns)
    for block in network["blocks"]:  # type: ignore[attr-defined]
        x = x + block["ls1"]["gamma"] * _attention(block["attn"], block["norm1"](x))
        hidden = torch.nn.functional.gelu(block["mlp"]["fc1"](block["norm2"](x)))
        x = x + block["ls2"]["gamma"] * block["mlp"]["fc2"](hidden)
    x = network["norm"](x)
    return x[:, 1:].transpose(1, 2).reshape(1, WIDTH, rows, columns), x[:, 0]


def _attention(layers: nn.ModuleDict, x: torch.Tensor) -> torch.Tensor:
    from torch.nn.functional import scaled_dot_product_attention

    count = x.shape[1]
    query, key, value = layers["qkv"](x).reshape(1, count, 3, _HEADS, WIDTH // _HEADS).permute(2, 0, 3, 1, 4)
    joined = scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(1, count, WIDTH)
    return layers["proj"](joined)  # type: ignore[no-any-return]


def _positions(stored: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
    """Return the position embedding for rows x columns patches, as published: bicubic, between patch centres."""
    import torch
    from torch.nn.functional import interpolate

    if (rows, columns) == (_GRID, _GRID):
        return stored
    grid = stored[:, 1:].reshape(1, _GRID, _GRID, WIDTH).permute(0, 3, 1, 2)
    # The tenth of a patch is the published code's: its weights were trained with it.
    factor = ((rows + 0.1) / _GRID, (columns + 0.1) / _GRID)
    resized = interpolate(grid, scale_factor=factor, mode="bicubic", align_corners=False)
    return torch.cat([stored[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)
