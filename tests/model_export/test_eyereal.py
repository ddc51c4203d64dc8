"""The published network: keys, size, requirements of checkpoints, and equality of inputs and outputs with the official
code's (golden arrays made by running that code)."""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from model_export.export import picture_file, picture_network, spectral_model  # noqa: E402
from model_export.eyereal import EyeRealNet  # noqa: E402
from runtime.content.eyereal import Pair, read_folder  # noqa: E402
from runtime.errors import InputError  # noqa: E402
from runtime.model.contract import parse_contract  # noqa: E402
from runtime.model.network import PictureProposal  # noqa: E402
from runtime.model.session import ModelSession  # noqa: E402
from runtime.model.solver import StepPredictor  # noqa: E402
from runtime.model.still import solve_still  # noqa: E402
from runtime.optics.stack import PanelStack  # noqa: E402
from runtime.support.artifacts import write_png  # noqa: E402
from runtime.support.picture_file import read_image  # noqa: E402
from tests.model_export.golden import EYES, SIZE, WIDTH, golden, picture, weights  # noqa: E402


def load_eyereal(path: Path) -> Any:
    return picture_network("eyereal", path, None, {})[0].net.eval()


def eyereal_file(path: Path | None, **how: Any) -> bytes:
    return picture_file(*picture_network("eyereal", path, None if path else 1, {} if path else {"width": 4}), **how)


def saved(path: Path, net: EyeRealNet) -> Path:
    """A checkpoint with everything that the official training saves: AdamW, a LambdaLR, and its command line."""
    parser = argparse.ArgumentParser()
    for option, default in (("--FOV", 40.0), ("--embed_dim", 4), ("--output_dir", "./outputs/"), ("--ground", None)):
        parser.add_argument(option, default=default)
    args = parser.parse_args([])
    args.train_NTF, args.local_rank, args.names = False, 0, ["chair"]
    optimizer = torch.optim.AdamW(net.parameters(), lr=2e-4, weight_decay=5e-5)
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0 / (1 + step))
    net.eval()(torch.rand(1, 18, 32, 32)).sum().backward()
    optimizer.step()
    table = {
        "model": net.state_dict(), "optimizer": optimizer.state_dict(), "epoch": 7, "args": args,
        "lr_scheduler": scheduler.state_dict(),
    }  # fmt: skip
    torch.save(table, path)
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(3)
    return saved(tmp_path_factory.mktemp("official") / "published.pth", EyeRealNet(4))


@pytest.fixture
def published(written: Path, tmp_path: Path) -> Path:
    """A checkpoint as the official code writes it, of a narrow network."""
    return Path(shutil.copy(written, tmp_path))


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


def test_a_published_checkpoint_is_imported_with_every_weight(published: Path) -> None:
    net = load_eyereal(published)
    state = torch.load(published, weights_only=False)["model"]
    assert all(torch.equal(value, state[key]) for key, value in net.state_dict().items())


@pytest.mark.parametrize("where", ["model", "args"])
def test_a_checkpoint_that_carries_code_is_refused_and_its_code_not_run(
    published: Path, tmp_path: Path, where: str
) -> None:
    """The allow-list holds the table that `args` is, and no type that it might contain."""
    ran = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[object, tuple[Path]]:
            return (Path.touch, (ran,))

    content = {"model": Evil()} if where == "model" else {"args": argparse.Namespace(hidden=Evil())}
    torch.save(torch.load(published, weights_only=False) | content, published)
    with pytest.raises(InputError, match="not a checkpoint of plain weights"):
        load_eyereal(published)
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
        ("surplus", "subnets.down9.weight: 1 keys do not belong to eyereal"),
        ("shape", "subnets.up1.conv.0.weight: has shape (2, 2), but eyereal requires"),
        ("nan", "contains numbers that are not finite"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_the_key_that_is_amiss(published: Path, change: str, problem: str) -> None:
    state = torch.load(published, weights_only=False)["model"]
    torch.save({"model": damaged(state, change)}, published)
    with pytest.raises(InputError, match=re.escape(problem)):
        load_eyereal(published)


# ---- equality with the official code


@pytest.fixture(scope="module")
def official(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of the golden arrays' weights."""
    net = EyeRealNet(WIDTH)
    shapes = {key: tuple(value.shape) for key, value in net.state_dict().items()}
    net.load_state_dict({key: torch.from_numpy(value) for key, value in weights(shapes).items()})
    path = tmp_path_factory.mktemp("official") / "official.pth"
    torch.save({"model": net.state_dict()}, path)
    return path


@pytest.mark.parametrize("place", EYES)
def test_the_forward_is_the_official_one(official: Path, place: str) -> None:
    """Aligned corners, padding on the remaining side, skip before upsampled, sigmoid less 0.2."""
    with torch.no_grad():
        ours = load_eyereal(official)(torch.from_numpy(golden(f"{place}_x"))[None])[0].numpy()
    assert golden(f"{place}_y").min() < -0.15, "the case must need the clip"
    np.testing.assert_allclose(ours, golden(f"{place}_y"), atol=2e-3)


def pair_of(folder: Path, place: str) -> Pair:
    """The golden pictures as the data set names them, read as the data set is."""
    for half, (x, y, z) in enumerate(EYES[place]):
        write_png(folder / f"pair0_x{x}_y{y}_z{z}_{half}.png", picture(half))
    (pair,) = read_folder(folder, "lego_bulldozer")
    return pair


def predictor_of(official: Path, folder: Path) -> StepPredictor:
    path = folder / "eyereal.onnx"
    path.write_bytes(eyereal_file(official, width_px=SIZE[0], height_px=SIZE[1], eye_order="right-left"))
    # The published code's panels of lego_bulldozer, with square pixels.
    stack = PanelStack(0.5184, 0.5184 * SIZE[1] / SIZE[0], (-0.06, 0.0, 0.06), *SIZE)
    session = ModelSession(path, threads=1)
    return StepPredictor(stack, PictureProposal(session, stack, source=path), (), name=session.contract.name)


@pytest.mark.parametrize("place", EYES)
def test_the_network_s_input_and_output_layers_are_the_official_code_s(
    official: Path, tmp_path: Path, place: str
) -> None:
    """All 18 channels of one pair: panel by panel, `_0` before `_1`, red before green before blue, black outside."""
    pair = pair_of(tmp_path, place)
    predictor = predictor_of(official, tmp_path)
    pictures = [read_image(path) for path in pair.paths]
    done = solve_still(*pictures, eyes_m=pair.eyes_m, fov_deg=40.0, predictor=predictor)
    fed, wanted = predictor._proposal._input[0], golden(f"{place}_x")
    if place == "near":
        assert (wanted == 0).mean() > 0.3, "the case must have black beside"
    codes = np.abs(fed - wanted) * 255
    for channel in range(18):
        assert codes[channel].mean() < 0.5, f"channel {channel}"
    assert np.quantile(codes, 0.99) < 8  # OpenCV samples at 1/32 of a pixel, and in 8 bits
    with torch.no_grad():
        answer = load_eyereal(official)(torch.from_numpy(fed.copy())[None])[0].numpy()
    # Equal outputs give equal grey levels: clipped, rounded half up.
    shown = np.floor(np.clip(answer, 0, 1) * 255 + 0.5).reshape(3, 3, *SIZE[::-1]).transpose(0, 2, 3, 1)
    assert np.abs(done.layers[..., :3] - shown).mean() < 0.02  # by way of sixteenths of a code
    apart = done.layers[..., :3].astype(float) - golden(f"{place}_layers")
    assert np.median(np.abs(apart)) <= 1
    assert abs(apart.mean()) < 0.25, "values that are cut off instead of rounded are half a level lower"
    predictor.close()


def test_pictures_of_another_view_are_black_outside_the_network_s_40_degrees(official: Path, tmp_path: Path) -> None:
    """`--fov 70` still gives the network its training input: the 40 degrees in the middle."""
    pair = pair_of(tmp_path, "near")
    predictor = predictor_of(official, tmp_path)
    white = np.full((200, 320, 3), 255, np.uint8)
    solve_still(white, white, eyes_m=pair.eyes_m, fov_deg=70.0, predictor=predictor)
    fed, beside = predictor._proposal._input[0], golden("near_x") == 0
    assert (fed[beside] < 0.6).all() and fed[beside].mean() < 0.01
    solve_still(white, white, eyes_m=pair.eyes_m, fov_deg=20.0, predictor=predictor)
    assert (predictor._proposal._input[0] == 0).mean() > 0.7, (
        "a smaller picture ends in black too, not in its repeated edge"
    )
    predictor.close()


def test_an_export_states_its_training_only_where_it_is_known(official: Path) -> None:
    def trained_for(data: bytes) -> object:
        import onnx

        model = onnx.load_from_string(data)
        return parse_contract({item.key: item.value for item in model.metadata_props}, source="x").trained_for

    size = {"width_px": 64, "height_px": 40}
    assert trained_for(eyereal_file(official, **size)) is None
    assert trained_for(eyereal_file(None, **size)) is None
    assert trained_for(spectral_model("fast")[0]) is not None
