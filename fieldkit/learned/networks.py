"""The paper's networks, weight for weight: they score a view by two logits, does not localize and does.

Torch is imported with this module: import it inside the functions that need it.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from fieldkit.views import HISTOGRAM_WIDTH, TOKEN_WIDTH

_WIDTH, _KEY_WIDTH = 128, 32


class Mlp(nn.Module):
    """The paper's MLP: logits f32[b, 2] of view histograms f32[b, 146]; 181,546 weights."""

    def __init__(self, *, dropout: float = 0.2) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv1d(1, 64, 3), nn.ReLU(), nn.MaxPool1d(2),
            nn.Conv1d(64, 32, 3), nn.ReLU(), nn.MaxPool1d(2, padding=1),
            nn.Flatten(),
        )  # fmt: skip
        widths = (1152, 128, 128, 64, 32, 16, 8)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Linear(before, after), nn.ReLU(), nn.Dropout(dropout)]
        self.head = nn.Sequential(*layers, nn.Linear(widths[-1], 2))
        assert HISTOGRAM_WIDTH == 146, "the first layer of the head counts on it"

    def forward(self, histograms: Tensor) -> Tensor:
        """Return logits f32[b, 2] of histograms f32[b, 146]."""
        logits: Tensor = self.head(self.convolutions(histograms[:, None]))
        return logits


class _Norm(nn.BatchNorm1d):
    """Batch normalisation over the tokens that are there: x f32[b, n, c], there bool[b, n]; others become 0."""

    def forward(self, x: Tensor, there: Tensor | None = None) -> Tensor:
        if there is None:
            return super().forward(x.flatten(0, -2)).view_as(x)
        if not self.training:
            return super().forward(x.flatten(0, -2)).view_as(x) * there[..., None]
        result = torch.zeros_like(x)
        result[there] = super().forward(x[there])
        return result


class _Attention(nn.Module):
    """Offset attention (Guo et al., Point Cloud Transformer, 2021): one projection for queries and keys, 32 wide."""

    def __init__(self) -> None:
        super().__init__()
        self.key = nn.Linear(_WIDTH, _KEY_WIDTH, bias=False)
        self.value = nn.Linear(_WIDTH, _WIDTH)
        self.out = nn.Linear(_WIDTH, _WIDTH)
        self.norm = _Norm(_WIDTH)

    def forward(self, x: Tensor, bias: Tensor, there: Tensor | None) -> Tensor:
        key = self.key(x)
        energy = torch.baddbmm(bias[:, None], key, key.transpose(1, 2), alpha=_KEY_WIDTH**-0.5)
        mixed = energy.softmax(dim=2) @ self.value(x)
        return x + torch.relu(self.norm(self.out(x - mixed), there))


class Vpt(nn.Module):
    """The paper's viewpoint transformer: logits f32[b, 2] of landmark tokens f32[b, n, 73]; 159,170 weights.

    With the three numbers of appearance, ``tokens=76``, it has 159,554. Tokens have no order: logits stay the same
    when they are permuted. A token of weight w counts in the attention as w equal tokens would (the logarithm of w is
    added to its energy), so that few tokens can stand for many without another result.
    """

    def __init__(self, *, tokens: int = TOKEN_WIDTH, dropout: float = 0.4) -> None:
        super().__init__()
        self.embedding = nn.Sequential(nn.Linear(tokens, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH), nn.ReLU())
        self.attention = nn.ModuleList([_Attention(), _Attention()])
        self.joint = nn.Linear(2 * _WIDTH, _WIDTH)
        self.joint_norm = _Norm(_WIDTH)
        self.head = nn.Sequential(
            nn.Linear(_WIDTH, 128), nn.BatchNorm1d(128), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(128, 64), nn.BatchNorm1d(64), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(64, 2),
        )  # fmt: skip

    def forward(self, tokens: Tensor, weight: Tensor | None = None) -> Tensor:
        """Return logits f32[b, 2] of tokens f32[b, n, c] with weights f32[b, n], 0 where a row only fills up.

        Every view needs a token of some weight; without weights every one counts once.
        """
        logits: Tensor = self.head(self.landmark_features(tokens, weight).amax(dim=1))
        return logits

    def landmark_features(self, tokens: Tensor, weight: Tensor | None = None) -> Tensor:
        """Return what the max pool sees of each token, f32[b, n, 128]; -inf where no token is."""
        x = self.embedding(tokens)
        bias = tokens.new_zeros(tokens.shape[:2]) if weight is None else weight.log()
        there = None if weight is None or bool((weight > 0).all()) else weight > 0
        parts = []
        for attention in self.attention:
            x = attention(x, bias, there)
            parts.append(x)
        y = nn.functional.leaky_relu(self.joint_norm(self.joint(torch.cat(parts, dim=2)), there), 0.2)
        return y if there is None else y.masked_fill(~there[..., None], -torch.inf)
