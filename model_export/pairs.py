"""Prepare training pairs for picture networks: the input, the targets and the eyes' rays."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from model_export.data import CENTRE, PITCH_WIDTH_M, TrainingPair, filling_fov_deg, random_pair, random_place
from model_export.light import Views
from model_export.modules import Form
from runtime.config import ContentSettings
from runtime.content.base import ContentSource, View
from runtime.content.eyereal import Pair, read_folder
from runtime.content.placed import Placing, placed_source
from runtime.content.presets import preset_names
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.model.warp import resample
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, image_from_stack, stack_from_eye
from runtime.records import F32
from runtime.support.gl import offscreen_context
from runtime.support.picture_file import read_image

PICTURE_FOV_DEG = 40.0  # field of view of the pictures in the published data set


@dataclass(frozen=True)
class TrainingPairs(Dataset[dict[str, Tensor]]):
    """Data set from a folder, a scene, or random scenes. A pair depends only on the seed and its number."""

    form: Form  # the network's input format
    seed: int
    width_px: int  # width of the panels and the pictures
    height_px: int  # height of the panels and the pictures
    eye_sigma_mm: float  # standard deviation of the tracking error along one axis
    count: int = 0  # number of different pairs before they repeat; 0 means unlimited
    stack: PanelStack | None = None  # panel geometry, or None for random panels
    folder: tuple[Pair, ...] = ()  # pairs to use; if empty, pairs are rendered or generated
    scene: str = ""  # scene to render at random rotations about the vertical axis; if empty, pairs are generated

    def __getitem__(self, number: int) -> dict[str, Tensor]:
        """Return a pair: the network's `input` (channels, H, W), and target intensities `targets` (2, 3, h, w).
        `believed` and `views` are homographies (2, N, 3, 3) as in `light.Views`, for the estimated and the true eyes.
        """
        pair = self.pair(number)
        random = np.random.default_rng([self.seed, number, 1])
        pose = stack_from_eye(pair.eyes_m.mean(axis=0))
        place = pose[:3, :2] @ random.normal(0.0, self.eye_sigma_mm * 1e-3, 2)
        places = np.stack([np.zeros(3), place])
        views = Views.of(pair.stack, pair.eyes_m, **self._size, fov_deg=pair.fov_deg, places_m=places)
        images = np.stack(pair.images).transpose(0, 3, 1, 2)
        return {
            "input": torch.from_numpy(network_input(pair, self.form)),
            "targets": torch.from_numpy(images.astype(np.float32) / np.float32(255)),
            "believed": views.panels_from_rays[:2],
            "views": views.panels_from_rays[2:],
        }

    @property
    def _size(self) -> dict[str, int]:
        return {"width_px": self.width_px, "height_px": self.height_px}

    def __len__(self) -> int:
        return self.count

    def pair(self, number: int) -> TrainingPair:
        """Return the pictures, panels and eye positions of the pair with this number."""
        if self.folder:
            pair = self.folder[number % len(self.folder)]
            return photographed(
                pair, self.stack or prototype(**self._size), self.form.picture_fov_deg or PICTURE_FOV_DEG
            )
        random = np.random.default_rng([self.seed, number % self.count if self.count else number])
        if self.scene:
            return self._drawn(random)
        return random_pair(random, **self._size, stack=self.stack, fov_deg=self.form.picture_fov_deg)

    def _drawn(self, random: np.random.Generator) -> TrainingPair:
        """Render the scene for random eye positions, at a random time and rotation about the vertical axis."""
        width_px, height_px = self.width_px, self.height_px
        stack, eyes_m = random_place(random, **self._size, stack=self.stack or prototype(**self._size))
        fov_deg = self.form.picture_fov_deg or filling_fov_deg(stack, eyes_m.mean(axis=0))
        placing = Placing(rotation_deg=(0.0, 0.0, random.uniform(0, 360)))
        source, time_ns = placed_source(opened(self.scene, stack, os.getpid()), placing), int(random.integers(10**11))
        images = []
        for side, eye in enumerate(eyes_m):
            projection = image_from_stack(eye, **self._size, fov_deg=fov_deg)
            picture = source.render(View(eye, side, projection, width_px, height_px), time_ns=time_ns)
            images.append(np.ascontiguousarray(picture[..., :3]))
        return TrainingPair(stack, eyes_m, (images[0], images[1]), fov_deg)


@lru_cache(maxsize=2)
def opened(scene: str, stack: PanelStack, _process: int) -> ContentSource:
    """Open a scene for rendering in this process, which must have a single thread. Raises InputError."""
    return open_content(ContentSettings(scene=scene), stack, offscreen_context())


def folder_pairs(folder: Path) -> tuple[Pair, ...]:
    """Read the pairs in a folder named and laid out like the published data set. Raises InputError."""
    name = next((name for name in preset_names() if name in folder.resolve().name), "")
    if not name:
        raise InputError(folder, "name", f"the folder's name must contain one of {', '.join(preset_names())}")
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder")
    return read_folder(folder, name)


def prototype(*, width_px: int, height_px: int) -> PanelStack:
    """Return the panels that the published pictures were rendered for."""
    return PanelStack(PITCH_WIDTH_M, PITCH_WIDTH_M * 9 / 16, (-0.06, 0.0, 0.06), width_px, height_px)


def photographed(pair: Pair, stack: PanelStack, fov_deg: float) -> TrainingPair:
    """Resample a published pair as if the eyes looked at the display's centre, at the panels' size."""
    size, images = {"width_px": stack.width_px, "height_px": stack.height_px}, []
    for side, eye_m in enumerate(pair.eyes_m):
        size_px = stack.width_px, stack.height_px
        picture = np.asarray(cv2.resize(read_image(pair.paths[side]), size_px, interpolation=cv2.INTER_AREA), np.uint8)
        drawn = pair.image_from_stack(side, **size, fov_deg=fov_deg)
        straight = image_from_stack(eye_m, **size, fov_deg=fov_deg)
        picture_from_straight = drawn[:, :3] @ np.linalg.inv(straight[:, :3])
        images.append(resample(picture, picture_from_straight, size=size_px[::-1], edge=cv2.BORDER_REPLICATE))
    return TrainingPair(stack, pair.eyes_m, (images[0], images[1]), fov_deg)


def network_input(pair: TrainingPair, form: Form) -> F32:
    """Return a picture network's input (channels, H, W), ordered by panel, then eye, then RGB."""
    stack, table = pair.stack, np.arange(256, dtype=np.float32) / np.float32(255)
    if form.input_value == "phase":
        table = phase_from_intensity(table, form.branch)
    border = cv2.BORDER_CONSTANT if form.picture_fov_deg else cv2.BORDER_REPLICATE
    channels = []
    for n in range(stack.count) if form.input_frame == "panel" else (CENTRE,):
        for eye_m, image in zip(pair.eyes_m, pair.images, strict=True):
            size = {"width_px": image.shape[1], "height_px": image.shape[0]}
            projection = image_from_stack(eye_m, **size, fov_deg=pair.fov_deg)
            picture_from_panel = image_from_raster(projection, stack.panel(n))
            warped = resample(image, picture_from_panel, size=(stack.height_px, stack.width_px), edge=border)
            channels.append(table[warped].transpose(2, 0, 1))
    return np.concatenate(channels)
