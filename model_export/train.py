"""Train a picture network, with the error in the light at the eyes as the loss (`phasestack train`).

The optimizer is AdamW with cosine decay of the learning rate. Pair k and all random numbers used in iteration k depend
only on the seed and k, so a training run that is interrupted and resumed gives the same result as an uninterrupted one.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.utils.data import DataLoader

from model_export.checkpoint import fill, load_checkpoint, save_checkpoint
from model_export.light import LEAST_ERROR, Views, improved, light, light_db
from model_export.modules import COLOURS, PANELS, Form, Network, blamed, make_network, probe
from model_export.pairs import TrainingPairs, folder_pairs
from model_export.ranks import Ranks, joined
from runtime.config import Section, load_stack
from runtime.errors import InputError
from runtime.report.page import drawing, png
from runtime.support.artifacts import write_bytes, write_text
from runtime.support.progress import progress_bar

HELD_OUT_SEED = 9_000_001  # seed for the validation pairs, greater than any training seed
HELD_OUT, HELD_OUT_SHARE = 6, 8  # number of generated validation pairs; one in this many pairs in a folder is held out
FIRST_SAVED = 10  # iteration of the first checkpoint, so that even a short training run can be resumed
SMALL_PX = 30_000  # pixels per batch; up to this number, one thread is faster (17 s instead of 24 s at 160x90)
COLUMNS = ("iteration", "light_db", "held_out_light_db")
Device = Literal["auto", "cpu", "cuda"]
Batch = dict[str, Tensor]


class Training(Section):
    """Settings that determine a training run's result. They are stored in the checkpoint."""

    arch: str
    options: Annotated[dict[str, Any], Field(default_factory=dict)]
    iterations: Annotated[int, Field(ge=1)] = 2000
    seed: Annotated[int, Field(ge=0, lt=HELD_OUT_SEED)] = 1
    width_px: Annotated[int, Field(ge=32, le=8192)] = 480
    height_px: Annotated[int, Field(ge=32, le=8192)] = 270
    batch: Annotated[int, Field(ge=1, le=256)] = 1
    pairs: Annotated[int, Field(ge=0)] = 0
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 1e-3
    eye_sigma_mm: Annotated[float, Field(ge=0, le=20)] = 1.0
    validate_every: Annotated[int, Field(ge=1)] = 100
    data: str = ""
    scene: str = ""
    panels: str = ""


def run_training(out: Path, training: Training, *, device: Device = "auto", resume: bool = False) -> dict[str, Any]:
    """Train a picture network, and write `checkpoint.pth`, `curve.csv` and `curve.png` to a folder at
    intervals. `resume` continues from its checkpoint. The processes of `torchrun` share each batch; all but the first
    write and return nothing. Raises InputError if the network, the data or the checkpoint is invalid, or the loss is
    not finite.
    """
    place = _placed(device)
    with joined(place, training.batch) as ranks:
        return _trained(out, training, ranks, resume=resume)


def _trained(out: Path, training: Training, ranks: Ranks, *, resume: bool) -> dict[str, Any]:
    place, start, is_first = ranks.place, time.monotonic(), ranks.rank == 0
    network = make_network(training.arch, training.options, seed=training.seed)
    probe(network, width_px=training.width_px, height_px=training.height_px)
    pairs, held_out = _data(training, network.form)
    net = network.net.to(place)
    optimizer = torch.optim.AdamW(net.parameters(), lr=training.learning_rate)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, training.iterations)
    done, curve, lights = 0, list[list[float]](), list[float]()
    if resume:
        done, curve, lights = _resumed(out, training, network, optimizer, rate)
    if place.type == "cpu" and training.width_px * training.height_px * training.batch <= SMALL_PX:
        torch.set_num_threads(1)
    unseen = list(DataLoader(held_out, 1, sampler=range(len(held_out))))

    def validated_db() -> float:
        return _held_out_db(network, unseen, place) if is_first else math.nan

    curve = curve or [[0, math.nan, validated_db()]]

    def save(number: int) -> None:
        if not is_first:
            return
        state: dict[str, Any] = {"model": net.state_dict(), "optimizer": optimizer.state_dict()}
        state |= {
            "rate": rate.state_dict(),
            "done": number,
            "lights": lights,
            "curve": curve,
            "training": training.model_dump(),
        }
        save_checkpoint(out / "checkpoint.pth", state)

    with progress_bar(f"training {training.arch}") as progress, _signals() as stop:
        for number, batch in enumerate(_loader(pairs, training, ranks, done), start=done + 1):
            torch.manual_seed(training.seed * HELD_OUT_SEED + number + (ranks.rank << 40))
            with blamed(training.arch, f"iteration {number}"):
                loss = _loss(network, _on(batch, place))
                optimizer.zero_grad(set_to_none=True)
                loss.backward()  # type: ignore[no-untyped-call]
            ranks.mean([loss, *(p.grad for p in net.parameters() if p.grad is not None)])
            if not torch.isfinite(loss):
                raise InputError(
                    training.arch, f"iteration {number}", "the measured light is not finite; lower the learning rate"
                )
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
            rate.step()
            lights.append(-loss.item())
            if is_first:
                progress(number, training.iterations)
            if ranks.any(bool(stop)):
                save(number)
                line = f"train: stopped after iteration {number} of {training.iterations}; pass --resume to continue"
                print(line, file=sys.stderr)
                raise SystemExit(128 + (stop or [signal.SIGTERM])[0])
            if number % training.validate_every and number != training.iterations:
                if number == FIRST_SAVED:
                    save(number)
                continue
            curve.append([number, sum(lights) / len(lights), validated_db()])
            lights.clear()
            save(number)
            if is_first:
                write_text(out / "curve.csv", "\n".join([",".join(COLUMNS), *map(_row, curve)]) + "\n")
                write_bytes(out / "curve.png", _drawn(curve, training.arch))
    if not is_first:
        return {}
    return {
        "arch": training.arch,
        "iterations": curve[-1][0],
        "seconds": round(time.monotonic() - start, 1),
        "start_db": round(curve[0][2], 3),
        "held_out_db": round(curve[-1][2], 3),
        "held_out_pairs": "the training pair" if pairs.folder == held_out.folder != () else held_out.count,
        "checkpoint": str(out / "checkpoint.pth"),
    }


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list, to check after each iteration, of the first SIGINT or SIGTERM; a second one exits immediately."""
    came: list[int] = []

    def take(number: int, frame: FrameType | None) -> None:
        if came:
            raise SystemExit(128 + number)
        came.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = {number: signal.signal(number, take) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def displayed(panels: Tensor) -> Tensor:
    """Clip panel values to [0, 1] and quantise them to 8 bits, with a straight-through gradient."""
    codes = (panels.clamp(0, 1) * 255).round() / 255
    return panels + (codes - panels).detach()


def _loss(network: Network, batch: Batch) -> Tensor:
    """Return the negated light PSNR in dB, averaged over pairs, which gives easy and hard ones equal weight."""
    with torch.autocast(batch["input"].device.type, torch.bfloat16, enabled=batch["input"].is_cuda):
        answer = network.net.train()(batch["input"])
    losses = []
    for panels, targets, matrices in zip(_shown(network, answer, batch), batch["targets"], batch["views"], strict=True):
        views = Views(matrices, targets.shape[-1], targets.shape[-2])
        seen, counts = light(panels, views)
        error = ((seen - targets) * counts).square().sum() / (counts.sum() * COLOURS)
        losses.append(10 * torch.log10(error + LEAST_ERROR))
    return torch.stack(losses).mean()


def _shown(network: Network, answer: Tensor, batch: Batch) -> Iterator[Tensor]:
    """Yield the displayed panel values (N, C, H, W) of each pair, after the solver's steps for the estimated eyes."""
    for panels, targets, matrices in zip(displayed(answer.float()), batch["targets"], batch["believed"], strict=True):
        views = Views(matrices, targets.shape[-1], targets.shape[-2])
        x = panels.reshape(PANELS, COLOURS, *panels.shape[1:])
        yield displayed(improved(x, targets, views, *network.steps()))


@torch.no_grad()
def _held_out_db(network: Network, batches: list[Batch], device: torch.device) -> float:
    """Return the validation pairs' mean light PSNR in dB, from unbiased estimates with random rays."""
    lights_db = []
    for number, batch in enumerate(_on(batch, device) for batch in batches):
        with blamed(network.arch, "validation"):
            answer = network.net.eval()(batch["input"])
        panels = next(_shown(network, answer, batch))
        targets = batch["targets"][0]
        views = Views(batch["views"][0], targets.shape[-1], targets.shape[-2])
        random = torch.Generator().manual_seed(number)
        lights_db.append(light_db(panels, targets, views, rays=1, random=random))
    return sum(lights_db) / len(lights_db)


def _data(training: Training, form: Form) -> tuple[TrainingPairs, TrainingPairs]:
    """Return training and validation pairs. Raises InputError for unsuitable panels, a folder, or folder and scene."""
    width_px, height_px = training.width_px, training.height_px
    stack = load_stack(Path(training.panels), width_px=width_px, height_px=height_px) if training.panels else None
    if stack is not None:
        stack = replace(stack, width_px=width_px, height_px=height_px)
        if stack.count != PANELS:
            raise InputError(training.panels, "x_m", f"has {stack.count} panels, but picture networks require {PANELS}")
    if training.data and training.scene:
        raise InputError("train", "--data", "cannot be combined with --scene")
    folder = folder_pairs(Path(training.data)) if training.data else ()
    held = folder[::-HELD_OUT_SHARE] if len(folder) > 1 else folder
    kept = tuple(pair for pair in folder if pair not in held) or folder
    learned = TrainingPairs(
        form=form, seed=training.seed, width_px=width_px, height_px=height_px, eye_sigma_mm=training.eye_sigma_mm,
        count=len(kept) or training.pairs, stack=stack, folder=kept, scene=training.scene,
    )  # fmt: skip
    return learned, replace(learned, seed=HELD_OUT_SEED, count=len(held) or HELD_OUT, folder=held)


def _loader(pairs: TrainingPairs, training: Training, ranks: Ranks, done: int) -> DataLoader[Batch]:
    """Load this process's share of the batches, each by its number alone, for the iterations after `done`."""
    size = training.batch
    numbers = range(done * size + ranks.rank, training.iterations * size, ranks.count)
    workers = min(8, len(os.sched_getaffinity(0)) - 1) if torch.cuda.is_available() else 0
    return DataLoader(pairs, size // ranks.count, sampler=numbers, num_workers=workers)


def _placed(device: Device) -> torch.device:
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("train", "--device", "cuda is not available because torch finds no GPU")
    if device == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def _on(batch: Batch, device: torch.device) -> Batch:
    return {name: value.to(device) for name, value in batch.items()}


def _resumed(
    out: Path, training: Training, network: Network, *parts: Any
) -> tuple[int, list[list[float]], list[float]]:
    """Restore weights, optimizer and learning rate (`parts`) from a checkpoint in a folder, made with equal settings.
    Return the number of completed iterations, the learning curve, and the light PSNR of every iteration since the
    curve's last point. Raises InputError if the checkpoint is invalid or has different settings.
    """
    path = out / "checkpoint.pth"
    table = load_checkpoint(path)
    was, now = table.get("training"), training.model_dump()
    if not isinstance(was, dict) or "curve" not in table:
        raise InputError(path, "training", "is missing, so this is not a checkpoint of `phasestack train`")
    for name, value in now.items():
        if was.get(name) != value:
            raise InputError(path, name, f"must be {was.get(name)!r} to resume this training, not {value!r}")
    fill(network.net, table["model"], source=path, arch=training.arch)
    with blamed(str(path), "optimizer"):
        for part, name in zip(parts, ("optimizer", "rate"), strict=True):
            part.load_state_dict(table[name])
    curve = [list(row) for row in table["curve"]]
    return int(table.get("done", curve[-1][0])), curve, list(table.get("lights", []))


def _row(point: list[float]) -> str:
    return ",".join("" if math.isnan(value) else f"{value:.6g}" for value in point)


def _drawn(curve: list[list[float]], title: str) -> bytes:
    """Plot the learning curve and return the PNG file."""
    with drawing(7, 4) as figure:
        axes = figure.add_subplot(title=title, xlabel="iterations", ylabel="light, dB")
        numbers, learned, held_out = zip(*curve, strict=True)
        axes.plot(numbers, learned, label="training pairs (model of light)")
        axes.plot(numbers, held_out, "o-", label="held-out pairs (random rays)")
        axes.legend()
    return png(figure)
