"""The published network: its keys and size, and what a checkpoint must be to be imported."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
from model_export.checkpoint import load_eyereal, load_spectral  # noqa: E402
from model_export.eyereal import OFFSET, EyeRealNet  # noqa: E402
from runtime.errors import InputError  # noqa: E402


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A checkpoint as the official code writes it, of a narrow network."""
    torch.manual_seed(3)
    path = tmp_path / "published.pth"
    torch.save({"model": EyeRealNet(4).state_dict(), "epoch": 7}, path)
    return path


@pytest.mark.parametrize(("width", "parameters"), [(32, 17_303_721), (16, 4_329_561)])
def test_it_has_as_many_parameters_as_published(width: int, parameters: int) -> None:
    assert sum(p.numel() for p in EyeRealNet(width).parameters()) == parameters


def test_it_has_the_keys_of_the_official_code() -> None:
    keys = set(EyeRealNet(4).state_dict())
    assert {
        "subnets.in_conv.0.weight",
        "subnets.down1.1.0.weight",
        "subnets.up1.conv.1.running_mean",
        "subnets.out_conv.0.bias",
    } <= keys


@pytest.mark.parametrize("size", [(64, 64), (67, 101), (33, 35)])
def test_any_size_from_32_up_comes_out_as_it_went_in(size: tuple[int, int]) -> None:
    with torch.no_grad():
        out = EyeRealNet(4).eval()(torch.rand(1, 18, *size))
    assert out.shape == (1, 9, *size)
    assert out.min() >= -OFFSET and out.max() <= 1 - OFFSET


def test_a_published_checkpoint_is_imported_with_every_weight(published: Path) -> None:
    net = load_eyereal(published)
    state = torch.load(published, weights_only=True)["model"]
    assert all(torch.equal(value, state[key]) for key, value in net.state_dict().items())


def test_a_checkpoint_that_runs_code_is_refused_and_its_code_not_run(tmp_path: Path) -> None:
    ran = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path(ran).__class__.touch, (ran,))  # type: ignore[return-value]

    path = tmp_path / "evil.pth"
    torch.save({"model": Evil()}, path)
    with pytest.raises(InputError, match="no checkpoint of plain weights"):
        load_eyereal(path)
    assert not ran.exists()


def damaged(state: dict[str, object], change: str) -> dict[str, object]:
    key = "subnets.up1.conv.0.weight"
    if change == "missing":
        return {k: v for k, v in state.items() if k != key}
    if change == "surplus":
        return {**state, "subnets.down9.weight": torch.zeros(1)}
    if change == "shape":
        return {**state, key: torch.zeros(2, 2)}
    return {**state, key: torch.full_like(state[key], float("nan"))}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("missing", "subnets.up1.conv.0.weight: 1 keys of eyereal are missing"),
        ("surplus", "subnets.down9.weight: 1 keys are not of eyereal"),
        ("shape", "subnets.up1.conv.0.weight: (2, 2), but eyereal has"),
        ("nan", "holds numbers that are not finite"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_the_key_that_is_amiss(published: Path, change: str, problem: str) -> None:
    state = torch.load(published, weights_only=True)["model"]
    torch.save({"model": damaged(state, change)}, published)
    with pytest.raises(InputError, match=re.escape(problem)):
        load_eyereal(published)


def test_a_checkpoint_of_another_architecture_is_refused_by_name(published: Path) -> None:
    with pytest.raises(InputError, match="is a checkpoint of eyereal, not of spectral"):
        load_spectral(published, name="balanced")


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 cut"])
def test_a_corrupt_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "corrupt.pth"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"corrupt\.pth"):
        load_eyereal(path)


def test_a_truncated_checkpoint_is_refused(published: Path) -> None:
    published.write_bytes(published.read_bytes()[:-4000])
    with pytest.raises(InputError, match=r"published\.pth"):
        load_eyereal(published)
