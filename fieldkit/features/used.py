"""Which weight files a feature, a matcher and a global descriptor use: results are made by them, too."""

from __future__ import annotations

from pathlib import Path

from fieldkit.features import feature_kind
from fieldkit.features.appearance import APPEARANCES
from fieldkit.features.weights import WEIGHTS, find_weights


def weight_files(
    feature: str, *, matcher: str = "nearest", retrieval: str | None = None, folder: Path | None = None
) -> list[Path]:
    """Return the files, in a fixed order, where ``folder`` or another place has them; none for SIFT alone.

    ``retrieval`` is the name of an appearance, or None or "own" where there is no network for it. Raises WeightsError
    as `find_weights` does.
    """
    kind = feature_kind(feature)
    appearance = None if retrieval is None or retrieval == "own" else APPEARANCES[retrieval].weights
    names = (kind.weights, kind.lightglue if matcher == "lightglue" else None, appearance)
    return [find_weights(WEIGHTS[name], folder=folder) for name in names if name is not None]
